"""The layout of Nerfies, which NeRF-DS, HyperNeRF and iPhone (DyCheck) share.

Required: dataset.json, metadata.json, scene.json, camera/<id>.json, rgb/<factor>x/<id>.png. Optional: points.npy or
sparse/0, resized_mask/<factor>x/<id>.png.png (0 = dynamic), depth/<factor>x/<id>.png or .npy,
covisible/<factor>x/val/<id>.png.
"""

import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from warpgs.cameras import Camera
from warpgs.config import MaskPerturbation
from warpgs.data import images
from warpgs.data.camera_files import read_camera
from warpgs.data.capture import SIDES, Capture, Frame, Side
from warpgs.data.lens import Lens
from warpgs.data.masks import perturb
from warpgs.data.points import read_points
from warpgs.data.time_source import TimeSource, with_steps
from warpgs.data.units import SceneUnits, read_units
from warpgs.data.writer import ESTIMATED, GIVEN, is_plain_id
from warpgs.errors import command, counted
from warpgs.files import read_json, read_numbers

from .listed import ListedFiles, find_file
from .options import LoadOptions
from .skipped import skipped_images
from .turned import turning_notes

LAYOUT = "a capture has dataset.json, metadata.json, scene.json, camera/<id>.json and rgb/<factor>x/<id>.png"


MAX_STEP = 10**19
"""Maximum time_id: today's nanoseconds since 1970 are 1.8e18."""

MAX_NAME = 200
"""Maximum length of the id of a frame; a file's name has at most 255 bytes."""


class Split(NamedTuple):
    """Ids of the frames to train on and to evaluate on; the file and its field that list the former, for messages."""

    source: Path
    train: list[str]
    val: list[str]
    field: str = "train_ids"


class NerfiesLoader(ABC):
    """A loader of the layout of Nerfies; a dataset derives from it and overrides what it does differently."""

    default_factor: int
    """Downscaling factor at which the dataset is usually evaluated."""

    @abstractmethod
    def recognizes(self, root: Path) -> bool: ...

    def split(self, root: Path, dataset: dict[str, Any], metadata: dict[str, Any]) -> Split:
        """train_ids and val_ids of dataset.json."""
        path = root / "dataset.json"
        return Split(path, read_ids(path, dataset, "train_ids"), read_ids(path, dataset, "val_ids"))

    def inverse_depth(
        self, path: Path, size: tuple[int, int], units: SceneUnits, image: Path
    ) -> Float[np.ndarray, "H W"]:
        """Inverse depth of a file that belongs to an image, resized to ``size`` (width, height).

        Here the files hold inverse depth already.
        """
        return images.read_depth(path, size, image)

    def has_metric_depth(self, paths: Iterable[Path]) -> bool:
        """Whether files hold depth in metres, the unit of the cameras, so that inverse depth has no offset."""
        return False

    def load(self, root: Path, options: LoadOptions, incomplete_masks: bool = False) -> Capture:
        """Opens a capture, as ``load_capture`` does; ``incomplete_masks``: training frames may lack masks."""
        dataset = read_json(root / "dataset.json", LAYOUT)
        metadata, units = read_json(root / "metadata.json", LAYOUT), read_units(root / "scene.json")
        split = self.split(root, dataset, metadata)
        _check_split(split)
        times, time_source = _times(root / "metadata.json", metadata, [*split.train, *split.val])
        factor = options.factor or self.default_factor
        files = _find_files(root, factor, split, incomplete_masks, options.depth)
        ids, cameras, lenses = _camera_ids(root / "metadata.json", metadata, [*times]), {}, {}
        for name, time in times.items():
            path = find_file(root / "camera", f"{name}.json") or root / f"camera/{name}.json"
            camera, lenses[name] = read_camera(path, units, factor, time, options.distortion)
            cameras[name] = replace(camera, id=ids[name])
        points, colors = read_points(root, units)
        read_depth = partial(_read_depth, self, units)
        reader = _FrameReader(cameras, lenses, files, frozenset(split.train), options.perturbation, read_depth)
        depths = [depth for name in split.train if (depth := files[name].depth) is not None]
        metric_depth = self.has_metric_depth(depths)
        listed = f"the split of {split.source.name} uses them neither for training nor for evaluation"
        return Capture(
            root.resolve().name,
            cameras,
            split.train,
            split.val,
            points,
            colors,
            reader.read,
            options.cache_frames,
            metric_depth=metric_depth,
            metres=1.0 / units.scale if depths and metric_depth else None,
            estimated_masks=_are_estimates(root / "dataset.json", dataset) and any(f.mask for f in files.values()),
            time_source=time_source,
            readout=float(read_numbers(root / "dataset.json", {"readout": 0.0, **dataset}, "readout", ())),
            readout_from=_side(root / "dataset.json", dataset),
            notes=[
                *turning_notes([files[name].image for name in cameras], [camera.size for camera in cameras.values()]),
                *skipped_images(root, (file.image for file in files.values()), listed),
            ],
        )


def _read_depth(
    loader: NerfiesLoader, units: SceneUnits, path: Path, size: tuple[int, int], image: Path
) -> Float[np.ndarray, "H W"]:
    return loader.inverse_depth(path, size, units, image)


def _side(path: Path, dataset: dict[str, Any]) -> Side:
    """``Capture.readout_from`` of dataset.json; raises ValueError if it is no side."""
    side = dataset.get("readout_from", "top")
    if side not in SIDES:
        raise ValueError(f"{path}: readout_from must be one of {', '.join(SIDES)}, got {reprlib.repr(side)}")
    return side


def _are_estimates(path: Path, dataset: dict[str, Any]) -> bool:
    masks = dataset.get("masks", GIVEN)
    if masks not in (GIVEN, ESTIMATED):
        raise ValueError(f"{path}: masks must be {GIVEN!r} or {ESTIMATED!r}, got {reprlib.repr(masks)}")
    return masks == ESTIMATED


def read_ids(path: Path, values: dict[str, Any], key: str) -> list[str]:
    """The list of frame ids under ``key``; empty if there is none.

    Raises:
        ValueError: If it is not a list of distinct names without slashes.
    """
    ids = values.get(key, [])
    if not isinstance(ids, list) or not all(isinstance(i, str) for i in ids) or len(set(ids)) < len(ids):
        raise ValueError(f"{path}: {key} must be a list of distinct ids")
    for i in ids:
        if not is_plain_id(i) or len(i) > MAX_NAME:
            raise ValueError(f"{path}: {key} must hold plain names, got {reprlib.repr(i)}")
    return ids


def metadata_field(metadata: dict[str, Any], name: str, key: str) -> Any:
    """A field of a frame in metadata.json; None if it is missing."""
    entry = metadata.get(name)
    return entry.get(key) if isinstance(entry, dict) else None


def _check_split(split: Split) -> None:
    if not split.train:
        some = f"some of the {counted(len(split.val), 'frame')} to evaluate on instead" if split.val else "some"
        raise ValueError(f"{split.source} has no frames to train on: its {split.field} must list {some}")
    if both := set(split.train) & set(split.val):
        raise ValueError(f"{split.source}: frame {min(both)} is listed for both training and evaluation")


def _times(path: Path, metadata: dict[str, Any], names: list[str]) -> tuple[dict[str, float], TimeSource]:
    """Time of each frame in [0, 1], from the first to the last: its time_id, or in older captures its warp_id."""
    steps = {key: {name: metadata_field(metadata, name, key) for name in names} for key in ("time_id", "warp_id")}
    given = {key: [name for name in names if steps[key][name] is not None] for key in steps}
    key = max(steps, key=lambda key: len(given[key]))
    for name, step in steps[key].items():
        if isinstance(step, bool) or not isinstance(step, int | float) or not 0 <= step <= MAX_STEP:
            raise ValueError(f"{path} has no time_id or warp_id for frame {name}: {step!r:.40}")
    first, last = min(steps[key].values()), max(steps[key].values())
    length = (last - first) or 1  # if all frames have one step, their time is 0
    problem = ""
    if key == "warp_id" and given["time_id"]:
        without = next(name for name in names if name not in given["time_id"])
        problem = f"{without} has no time_id, which {len(given['time_id'])} of {len(names)} frames have"
    text = with_steps(f"times from {key} in {path.name}", [float(step) for step in steps[key].values()])
    return {name: (step - first) / length for name, step in steps[key].items()}, TimeSource(text, problem)


def _camera_ids(path: Path, metadata: dict[str, Any], names: list[str]) -> dict[str, int]:
    """The camera_id of each frame; 0 if no frame has one."""
    ids = {name: metadata_field(metadata, name, "camera_id") for name in names}
    if all(i is None for i in ids.values()):
        return dict.fromkeys(names, 0)
    for name, i in ids.items():
        if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i <= MAX_STEP:
            others = f"which {sum(i is not None for i in ids.values())} of {len(ids)} frames have"
            raise ValueError(f"{path}: {name} has no camera_id from 0 on, {others}: {reprlib.repr(i)}")
    return ids


@dataclass(frozen=True)
class _FrameFiles:
    """Files of a frame; None for those that the capture does not have."""

    image: Path
    mask: Path | None
    depth: Path | None
    covisible: Path | None


def _find_files(
    root: Path, factor: int, split: Split, incomplete_masks: bool, with_depth: bool
) -> dict[str, _FrameFiles]:
    """Files of every frame: every frame has an image, and every training frame a mask if there are any masks.

    Masks of some training frames suffice if they may be incomplete.
    """
    rgb, size = root / "rgb", f"{factor}x"
    if not (rgb / size).is_dir():
        found = ", ".join(sorted(p.name for p in rgb.glob("*x")))
        raise ValueError(
            f"{rgb / size} is missing: " + (f"{rgb} has {found}, --factor chooses among them" if found else LAYOUT)
        )
    masks = next((p for p in (root / "resized_mask", root / "mask") if p.is_dir()), None)
    if masks is not None and not (masks / size).is_dir() and not incomplete_masks:
        raise ValueError(f"{masks / size} is missing: images are read from {rgb / size}, masks must have the same size")
    files, listed = {}, ListedFiles(rgb / size, "dataset.json")
    for name in [*split.train, *split.val]:
        image = listed.find(name, (".png", ".jpg", ".jpeg"))
        if image is None:
            raise ValueError(listed.missing(f"{name}.png", "dataset.json lists the frame"))
        mask = None if masks is None else find_mask(masks, factor, name)
        depth = find_depth(root, factor, name) if with_depth else None
        covisible = find_file(root / "covisible" / size / "val", f"{name}.png")
        files[name] = _FrameFiles(image, mask, depth, covisible)
    for name in split.train:
        if masks is not None and files[name].mask is None and not incomplete_masks:
            raise ValueError(
                f"{masks / size / name}.png.png is missing: every training frame needs its mask; "
                f"{command('prepare', root, '--add', 'masks')} makes those that are missing"
            )
    return files


def find_mask(folder: Path, factor: int, name: str) -> Path | None:
    """The mask of a frame at a downscaling factor in ``folder``, resized_mask or mask; None if it has none."""
    return find_file(folder / f"{factor}x", name, (".png.png", ".png"))


def find_depth(root: Path, factor: int, name: str) -> Path | None:
    """The depth of a frame for images at a downscaling factor; None if it has none."""
    # Depth is resized to the image, so the full size serves every factor.
    folders = [root / f"depth/{size}x" for size in (factor, 1)]
    return next((path for folder in folders if (path := find_file(folder, name, (".npy", ".png")))), None)


@dataclass(frozen=True)
class _FrameReader:
    """Reads frames.

    Attributes:
        cameras, lenses, files: Of each frame.
        train: Frames whose masks are perturbed.
        perturbation: Perturbation of their masks.
        read_depth: Reads the inverse depth of an image in a size (width, height).
    """

    cameras: dict[str, Camera]
    lenses: dict[str, Lens]
    files: dict[str, _FrameFiles]
    train: frozenset[str]
    perturbation: MaskPerturbation
    read_depth: Callable[[Path, tuple[int, int], Path], np.ndarray]

    def read(self, name: str) -> Frame:
        files, size = self.files[name], self.cameras[name].size

        def optional(read: Callable[[Path, tuple[int, int], Path], np.ndarray], path: Path | None) -> np.ndarray | None:
            return None if path is None else read(path, size, files.image)

        mask = optional(images.read_mask, files.mask)
        if mask is not None and name in self.train:
            mask = perturb(mask, self.perturbation, name)
        depth, covisible = optional(self.read_depth, files.depth), optional(images.read_mask, files.covisible)
        return Frame(
            name,
            self.cameras[name],
            torch.from_numpy(images.read_image(files.image, size)),
            None if mask is None else torch.from_numpy(mask),
            None if depth is None else torch.from_numpy(depth * self.lenses[name].axial_depths()),
            None if covisible is None else torch.from_numpy(covisible),
        )
