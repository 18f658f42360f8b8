"""Cameras from files, to film at exactly: COLMAP models, OpenUSD, and transforms.json as of nerfstudio and Blender.

They are in the coordinates of the scene. ``applied_transform`` of a transforms.json says how these became those of the
file, and is undone.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from warpgs.cameras import Camera
from warpgs.captures.findings import few_of
from warpgs.data.camera_files import is_rotation
from warpgs.data.capture import Capture
from warpgs.data.colmap import load_model
from warpgs.data.colmap_folders import find_models
from warpgs.data.lens import Lens
from warpgs.data.loaders.listed import without_image_suffix
from warpgs.data.loaders.transforms import Transforms
from warpgs.files import natural_order, read_numbers

from .camera_paths import MAX_FRAMES, evenly_spaced, filling
from .usd_cameras import SUFFIXES, read_usd_cameras

INDEX = "transforms.json"

TURNED = 0.02
"""Difference of rotations and, in scene units, of translations that corrections of poses stay below."""


def read_cameras(path: Path, capture: Capture, name: str | None = None) -> list[Camera]:
    """The cameras of a file, with the size of the first one, in the order of their times, else of their names.

    Without times, those that are called like frames of the capture have their times; others are evenly spaced.

    Args:
        path: A transforms.json, or a folder that has one or a COLMAP model, or a file of OpenUSD.
        capture: The capture of the run.
        name: Of the camera in a file of OpenUSD.

    Raises:
        ValueError: If there is no such file, it is damaged, a lens is not supported, a time is outside of [0, 1], or it
            has none and only some cameras are called like frames; or as ``read_usd_cameras``.
        OSError: As ``read_usd_cameras``.
    """
    if path.suffix in SUFFIXES and not path.is_dir():
        return _in_time(read_usd_cameras(path, capture, name))
    if name is not None:
        raise ValueError(f"--view chooses a camera of a file of OpenUSD ({', '.join(SUFFIXES)}), not of {path}")
    if path.is_dir() and not (path / INDEX).is_file():
        named, times = _of_colmap(path)
    else:
        index = path / INDEX if path.is_dir() else path
        if index.suffix != ".json":
            raise ValueError(f"{path} is neither a transforms.json, a USD file nor a folder that has a COLMAP model")
        named, times = _of_transforms(index)
    if len(named) > MAX_FRAMES:
        raise ValueError(f"{path} has {len(named):,} cameras, the maximum is {MAX_FRAMES:,}")
    if times is None and (times := _times_of_frames(path, [name for name, _ in named], capture)):
        _refuse_turned(path, named, capture)
    return _in_time([*zip(times or evenly_spaced(len(named)), (camera for _, camera in named), strict=True)])


def _in_time(timed: list[tuple[float, Camera]]) -> list[Camera]:
    """The cameras in the order of their times, with the size of the first one."""
    by_time = sorted(timed, key=_time)
    first = by_time[0][1]
    cameras = [dataclasses.replace(camera, time=float(time)) for time, camera in by_time]
    return [camera if camera.size == first.size else filling(camera, first.size) for camera in cameras]


def _times_of_frames(path: Path, images: Sequence[str], capture: Capture) -> list[float] | None:
    """The times of the frames that images are; None if they are other images.

    Raises:
        ValueError: If some of them are frames and others are not.
    """
    frames = [_frame_of(image, capture) for image in images]
    missing = [image for image, frame in zip(images, frames, strict=True) if frame is None]
    if missing and len(missing) < len(images):
        raise ValueError(
            f"{path}: {len(missing)} of {len(images)} images are no frames of the capture, which tell the times: "
            f"{few_of(missing)}; expected names such as {next(iter(capture.cameras))}"
        )
    return None if missing else [capture.cameras[frame].time for frame in frames if frame is not None]


def _frame_of(image: str, capture: Capture) -> str | None:
    """The frame of an image: ids have underscores for slashes, without folders that all images of the capture share."""
    parts = Path(without_image_suffix(image)).parts
    names = ("_".join(parts[k:]) for k in range(len(parts)))
    return next((name for name in names if name in capture.cameras), None)


Named = list[tuple[str, Camera]]
"""Cameras with the names of their images, at least one, in the order of these."""


def _refuse_turned(path: Path, named: Named, capture: Capture) -> None:
    """Raises ValueError if cameras are those of the capture in the coordinates of an exported scene.

    A rotation of the world changes all rotations of world to camera by the same factor, and no translation.
    """
    own = torch.stack([capture.cameras[_frame_of(image, capture) or ""].viewmat.cpu() for image, _ in named])
    given = torch.stack([camera.viewmat for _, camera in named])
    turns = given[:, :3, :3].mT @ own[:, :3, :3]
    is_turned = (turns[0] - torch.eye(3)).abs().max() > TURNED
    alike = (turns - turns[0]).abs().max() < TURNED
    if is_turned and alike and torch.allclose(given[:, :3, 3], own[:, :3, 3], rtol=TURNED, atol=TURNED):
        raise ValueError(f"{path} has the capture's cameras, turned as in an exported file: export with --up scene")


def _time(item: tuple[float, Camera]) -> float:
    return item[0]


def _of_colmap(folder: Path) -> tuple[Named, None]:
    """The cameras of a model, which has no times."""
    found, others = find_models(folder), sorted(path.name for path in folder.glob("transforms_*.json"))
    if others and not found:
        raise ValueError(f"{folder} has neither {INDEX} nor a COLMAP model: give one of its files, {few_of(others)}")
    model = load_model(found[0].folder if found else folder)
    images = sorted(model.images, key=lambda image: natural_order(image.name))
    if not images:
        raise ValueError(f"{folder} has no image with a pose")
    return [(image.name, _camera(image.lens, image.pose)) for image in images], None


def _of_transforms(path: Path) -> tuple[Named, Sequence[float] | None]:
    """The cameras of a transforms.json, and their times if it has any."""
    transforms = Transforms(path)
    frames = sorted(transforms.frames, key=lambda frame: natural_order(str(frame.get("file_path"))))
    applied = np.eye(4)[:3]
    if "applied_transform" in transforms.fields:
        applied = read_numbers(path, transforms.fields, "applied_transform", (3, 4))
        if not is_rotation(applied[:, :3]):
            raise ValueError(f"{path}: applied_transform must be a rotation and a translation")
    named = []
    for frame in frames:
        has_size = {"w", "h"} <= {*transforms.fields, *frame}
        lens = transforms.lens(frame, Path() if has_size else transforms.image(frame))
        pose = transforms.pose(frame)
        moved = np.hstack([pose[:, :3] @ applied[:, :3], pose[:, :3] @ applied[:, 3:] + pose[:, 3:]])
        named.append((str(frame.get("file_path")), _camera(lens, moved)))
    given = transforms.times(frames, "time")
    if given is not None and not all(0 <= time <= 1 for time in given[1]):
        raise ValueError(f"{path}: time must be in [0, 1], from the first frame of the capture to the last")
    return named, None if given is None else given[1]


def _camera(lens: Lens, pose: np.ndarray) -> Camera:
    """The camera of a lens and a [3, 4] world-to-camera pose."""
    viewmat = torch.eye(4, dtype=torch.float32)
    viewmat[:3] = torch.from_numpy(pose)
    K = torch.tensor(lens.matrix, dtype=torch.float32)
    return Camera(viewmat, K, lens.width, lens.height, distortion=lens.distortion)
