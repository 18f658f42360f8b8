"""Dataset loaders, one file per dataset.

To add a dataset, write a ``Loader`` in a new file, add a line to ``LOADERS`` and a test. Datasets in the layout of
Nerfies derive theirs from ``nerfies.NerfiesLoader``; ``Loader`` itself requires no layout.
"""

from functools import partial
from pathlib import Path
from typing import Protocol

from warpgs.data.camera_ids import with_camera_ids
from warpgs.data.capture import Capture
from warpgs.data.colmap_folders import find_models
from warpgs.data.image_circle import with_image_circle
from warpgs.data.masks import check_perturbation
from warpgs.data.missing import missing_capture
from warpgs.data.readout import with_readout
from warpgs.data.tracks import read_tracks
from warpgs.data.writer import FINISHED, STATE, WORK
from warpgs.errors import command, not_one_of
from warpgs.files import read_json

from .blender import BlenderLoader
from .colmap import ColmapLoader
from .dynerf import DynerfLoader
from .hypernerf import HyperNerfLoader
from .iphone import IPhoneLoader
from .llff import LlffLoader
from .megasam import MegaSamLoader
from .nerfds import NerfDsLoader, is_ambiguous
from .nerfstudio import NerfstudioLoader
from .options import LoadOptions
from .skipped import IMAGE_SUFFIXES
from .vipe import VipeLoader

__all__ = [
    "LOADERS",
    "LoadOptions",
    "Loader",
    "describe_layout",
    "is_capture",
    "load_with",
    "recognize",
    "require_capture",
]


class Loader(Protocol):
    """Reads the captures of one dataset."""

    def recognizes(self, root: Path) -> bool:
        """Whether the files in ``root`` look like a capture of this dataset."""
        ...

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        ...


LOADERS: dict[str, Loader] = {
    "iphone": IPhoneLoader(),
    "nerfds": NerfDsLoader(),
    "hypernerf": HyperNerfLoader(),
    "nerfstudio": NerfstudioLoader(),
    "blender": BlenderLoader(),
    "dynerf": DynerfLoader(),
    "llff": LlffLoader(),
    "colmap": ColmapLoader(),
    "vipe": VipeLoader(),
    "megasam": MegaSamLoader(),
}
"""Loader of each dataset; a folder is read by the first one that recognizes it."""

MIN_SIDE = 2
"""Minimum side of an image, after it is downscaled [px]."""

FALLBACK = "hypernerf"
"""Dataset of a folder that no loader recognizes; the errors of its loader name what is missing."""


def load_with(root: Path, dataset: str | None, options: LoadOptions) -> Capture:
    """Opens the capture in a folder; arguments and errors as for ``load_capture`` (captures/opening.py)."""
    if dataset is not None and dataset not in LOADERS:
        raise ValueError(not_one_of("dataset", dataset, LOADERS))
    factor = options.factor
    if factor is not None and factor < 1:
        raise ValueError(f"factor must be at least 1, got {factor}")
    check_perturbation(options.perturbation)
    if dataset is not None and not root.exists():
        raise ValueError(missing_capture(root, is_capture))
    require_finished(root)
    layout = dataset or _recognized(root)
    if layout is None:
        require_capture(root)
    layout = layout or FALLBACK
    capture = LOADERS[layout].load(root, options)
    _require_sides(root, capture)
    capture = with_camera_ids(with_image_circle(capture))
    capture.layout = describe_layout(root, layout, dataset)
    capture.read_tracks = partial(read_tracks, root, capture.film)
    try:
        readout = capture.readout if options.readout is None else options.readout
        return with_readout(capture, readout, options.readout_from or capture.readout_from)
    except ValueError as error:
        raise ValueError(f"{root}: {error}") from error


def _require_sides(root: Path, capture: Capture) -> None:
    """Raises ValueError if an image is a line: it has no gradient across, and no half of its size."""
    for name, camera in capture.cameras.items():
        if min(camera.size) < MIN_SIDE:
            size, expected = f"{camera.width}×{camera.height}", f"at least {MIN_SIDE} pixels per side"
            raise ValueError(f"{root}: frame {name} is {size}, expected {expected}; --factor divides the size of files")


def is_vrig(root: Path, dataset: str | None) -> bool:
    """Whether a folder has one of HyperNeRF's captures of two cameras; false if it cannot be read."""
    try:
        loader = LOADERS[dataset or recognize(root)]
        return isinstance(loader, HyperNerfLoader) and loader.is_vrig(root)
    except (KeyError, ValueError, OSError):
        return False


def is_capture(root: Path) -> bool:
    """Whether a folder looks like a capture: it has a dataset.json, or a loader recognizes its files."""
    return (root / "dataset.json").exists() or any(loader.recognizes(root) for loader in LOADERS.values())


def require_capture(root: Path) -> None:
    """Raises ValueError if a path has no part of a capture; if it has some, the loader says what is missing."""
    if is_capture(root) or any((root / part).exists() for part in ("metadata.json", "scene.json", "camera", "rgb")):
        return
    if not root.exists():
        raise ValueError(missing_capture(root, is_capture))
    if root.is_file():
        made = command("prepare", root, "CAPTURE", "--holdout", "8")
        raise ValueError(f"{root} is a file: give the folder of the capture; {made} makes one of a video")
    if (root / "config.json").exists():
        raise ValueError(
            f"{root} is a run folder: give the capture that it was trained on; "
            f"{command('train', '--resume', root)} trains on"
        )
    for parent in root.resolve().parents[:2]:
        if is_capture(parent):
            raise ValueError(f"{root} is a part of a capture: give {parent}")
    if find_models(root):
        raise ValueError(f"{root} has a COLMAP model, but not the folder images/ with its images")
    if any(path.suffix.lower() in IMAGE_SUFFIXES for path in root.glob("*.*")):
        made = command("prepare", root, "CAPTURE", "--holdout", "8")
        raise ValueError(f"{root} has images, but no cameras: {made} makes a capture of them")
    raise ValueError(
        f"{root} has no dataset.json and the files of no other layout ({', '.join(LOADERS)}); warpgs prepare makes a "
        "capture of a video or a folder of frames"
    )


def require_finished(root: Path) -> None:
    """Raises ValueError if ``warpgs prepare`` was interrupted in a folder; says how it goes on."""
    work, sources = root / WORK, ["VIDEO"]
    try:
        state = read_json(work / STATE)
        if FINISHED in state["done"]:
            return
        given = dict(state.get("options", {})).get("source", sources)
        sources = given if isinstance(given, list) else [given]
    except (ValueError, KeyError, TypeError):  # no such file, or none of its own
        if not work.is_dir() or is_capture(root):
            return
    goes_on = f"the same command continues it ({command('prepare', *sources, root)}, with its options)"
    instead = f"; or remove {work} to use what is there" if is_capture(root) else ""
    raise ValueError(f"{root} is not finished: warpgs prepare was interrupted, or still runs; {goes_on}{instead}")


def recognize(root: Path) -> str:
    """The layout of a capture, as a key of ``LOADERS``: ``layout`` in its dataset.json, or that of its files."""
    return _recognized(root) or FALLBACK


def _recognized(root: Path) -> str | None:
    """As ``recognize``; None if no loader recognizes the files."""
    recognized = (name for name, loader in LOADERS.items() if loader.recognizes(root))
    return _named_layout(root) or next(recognized, None)


def describe_layout(root: Path, name: str, dataset: str | None) -> str:
    """The layout that ``load_with`` reads a capture in, for the middle of messages; says if it is a guess.

    Args:
        root: Folder of the capture.
        name: Key of ``LOADERS``.
        dataset: Key that was asked for; None if ``name`` was recognized.
    """
    other = {"nerfds": "hypernerf", "hypernerf": "nerfds"}
    if dataset or _named_layout(root) or name not in other or not is_ambiguous(root):
        return name
    return f"{name}, a guess that --dataset {other[name]} overrides"


def _named_layout(root: Path) -> str | None:
    """``layout`` in dataset.json; None if it is not there or not a key of ``LOADERS``."""
    try:
        named = read_json(root / "dataset.json").get("layout")
    except ValueError:  # no file, or one that the loader reports
        return None
    return named if isinstance(named, str) and named in LOADERS else None
