"""Opens what can be rendered: a run folder, a file of Gaussians, or a folder of such files over time."""

import os
import re
import reprlib
from pathlib import Path

from warpgs.config import Device, Plan, TrainConfig
from warpgs.files import natural_order
from warpgs.formats.readers import READERS, is_readable
from warpgs.runtime.devices import choose_device

from .config_file import NAME
from .run import Run
from .scene_file import SceneFile
from .trained import TrainedScene


def open_scene(path: Path, device: Device | None = None, data: Path | None = None) -> Run:
    """Opens a run folder, or files of Gaussians like one.

    Args:
        path: Run folder; or a file with a suffix in ``READERS``; or a folder of such files, whose names differ in their
            numbers alone, in the order of these.
        device: Device for the scene; CUDA if None and there is a GPU.
        data: Current folder of the capture; of files, one in their coordinates.

    Raises:
        ValueError: If it is none of these, or as ``Run.open``.
    """
    files = _files_of(path)
    if not files:
        return Run.open(path, device, data)
    name = files[0].name.split(".")[0] or files[0].name
    folder = path if path.is_dir() else path.with_name(name)
    if (folder / NAME).exists():  # of a run, whose edits and videos are its own
        folder = path.with_name(files[0].name.replace(".", "-"))
    plan = Plan.of(TrainConfig(data=data, out=folder, preset=None), choose_device(device), "black", False)
    return SceneFile(folder, plan, files)


def open_run(folder: Path | str, device: Device | None = None) -> TrainedScene:
    """The trained scene of a run folder: ``open_run("runs/builtin-quick").render(camera)``.

    Args:
        folder: Run folder, or files of Gaussians as of ``open_scene``.
        device: Device to render on; CUDA if None and there is a GPU.

    Raises:
        ValueError: If it is neither, has no checkpoint or is damaged.
        OSError: If a file needs a package that is not installed.
    """
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"a run is opened by the path of its folder, got {reprlib.repr(folder)}")
    return open_scene(Path(folder), device).trained_scene()


def _files_of(path: Path) -> tuple[Path, ...]:
    """The files of Gaussians that a path means; none if it may be a run folder.

    Raises:
        ValueError: If it is another file, or a folder of files of several scenes.
    """
    if path.is_file():
        if not is_readable(path):
            raise ValueError(f"{path}: expected a run folder or a file that ends with {', '.join(READERS)}")
        return (path,)
    if not path.is_dir() or (path / NAME).exists():
        return ()
    found = sorted((file for file in path.iterdir() if is_readable(file)), key=lambda file: natural_order(file.name))
    scenes = sorted({re.sub("[0-9]+", "*", file.name) for file in found})
    if len(scenes) > 1:
        raise ValueError(f"{path} has files of several scenes, {', '.join(scenes[:4])}: keep one in a folder")
    return tuple(found)
