"""Captures in the layout of Nerfies: NeRF-DS, HyperNeRF, and iPhone (DyCheck).

dataset.json, metadata.json, scene.json, camera/<id>.json, rgb/<factor>x/<id>.png, points.npy; and where there are:
resized_mask/<factor>x/<id>.png.png (0 = moving), depth/<factor>x/<id>.png or .npy, covisible/<factor>x/val/<id>.png,
splits/train.json and val.json, sparse/0.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from warpgs.cameras import Camera
from warpgs.config import MaskPerturbation
from warpgs.data import images
from warpgs.data.camera_files import read_camera
from warpgs.data.capture import Capture, Frame
from warpgs.data.lens import Lens, undistort
from warpgs.data.masks import check_perturbation, perturb
from warpgs.data.points import read_points
from warpgs.data.units import read_units
from warpgs.files import read_json

Dataset = Literal["nerfds", "hypernerf", "iphone"]

FACTORS: dict[Dataset, int] = {"nerfds": 1, "hypernerf": 2, "iphone": 2}
"""Downscaling of the pictures that each dataset is usually evaluated at."""

CLAMPED_DEPTH = 3.0
"""Metres that DyCheck's processing writes for everything from there on: exactly this value is no measurement."""

LAYOUT = "a capture has dataset.json, metadata.json, scene.json, camera/<id>.json and rgb/<factor>x/<id>.png"


def load_capture(
    root: Path,
    dataset: Dataset | None = None,
    *,
    factor: int | None = None,
    perturbation: MaskPerturbation | None = None,
    cache_frames: int = 256,
) -> Capture:
    """Opens a capture: reads cameras and points and finds that every file is there; pictures are read as they are used.

    Args:
        root: Folder with dataset.json.
        dataset: Layout; recognised from the files if None.
        factor: Downscaling of the pictures, the folder rgb/<factor>x; the dataset's usual one if None.
        perturbation: Damage to the masks of training frames; evaluation frames keep the true ones.
        cache_frames: Frames to keep in memory.

    Raises:
        ValueError: On anything missing, damaged or inconsistent; one line that names the file.
    """
    perturbation = perturbation or MaskPerturbation()
    check_perturbation(perturbation)
    facts = read_json(root / "dataset.json", LAYOUT)
    kind, factor = _layout(root, dataset, factor)
    metadata, units = read_json(root / "metadata.json", LAYOUT), read_units(root / "scene.json")
    train, val = _split(root, kind, facts, metadata)
    times = _times(root / "metadata.json", metadata, [*train, *val])
    files = _find_files(root, factor, train, val)
    cameras, lenses = {}, {}
    for name, time in times.items():
        cameras[name], lenses[name] = read_camera(root / f"camera/{name}.json", units, factor, time)
    points, colors = read_points(root, units)
    reader = _Reader(cameras, lenses, files, frozenset(train), perturbation, units.scale if kind == "iphone" else None)
    return Capture(root.resolve().name, cameras, train, val, points, colors, reader.read, cache_frames)


def _layout(root: Path, dataset: Dataset | None, factor: int | None) -> tuple[Dataset, int]:
    if dataset is not None and dataset not in FACTORS:
        raise ValueError(f"unknown dataset {dataset!r}, expected one of {', '.join(FACTORS)}")
    if factor is not None and factor < 1:
        raise ValueError(f"factor must be at least 1, got {factor}")
    kind = dataset or recognise(root)
    return kind, factor or FACTORS[kind]


def recognise(root: Path) -> Dataset:
    """Which dataset's layout the files have.

    iPhone: splits/train.json, covisible/<factor>x/val, or depth of camera 0 as .npy. (DyCheck adds splits,
    co-visibility and extra.json to HyperNeRF's captures too, but names those splits train_mono, train_intl, …)
    NeRF-DS: masks in full size, or pictures in no other. Else HyperNeRF.
    """
    signs = (root.glob("covisible/*x/val"), root.glob("depth/*x/0_*.npy"))
    if (root / "splits/train.json").is_file() or any(next(sign, None) for sign in signs):
        return "iphone"
    full_size = (root / "resized_mask/1x").is_dir() or not (root / "rgb/2x").is_dir()
    return "nerfds" if full_size and (root / "rgb/1x").is_dir() else "hypernerf"


def _split(root: Path, kind: Dataset, facts: dict[str, Any], metadata: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Ids to train on and to evaluate on."""
    path = root / "dataset.json"
    train, val = _ids(path, facts, "train_ids"), _ids(path, facts, "val_ids")
    if kind == "iphone" and (root / "splits/train.json").is_file():
        path = root / "splits/train.json"
        train = _ids(path, read_json(path), "frame_names")
        val = _ids(root / "splits/val.json", read_json(root / "splits/val.json"), "frame_names")
    elif kind == "iphone" and not train:
        ids = _ids(path, facts, "ids")
        train, val = ([i for i in ids if (_fact(metadata, i, "camera_id") == 0) == first] for first in (True, False))
    elif kind == "hypernerf" and (not val or set(train) & set(val)):
        # The interpolation captures have one camera: every fourth frame trains, those half-way evaluate.
        ids = _ids(path, facts, "ids") or train
        train, val = ids[::4], ids[2::4]
    if not train:
        raise ValueError(f"{path} has no frames to train on")
    if shared := set(train) & set(val):
        raise ValueError(f"{path}: frame {min(shared)} is both trained on and evaluated on")
    return train, val


def _ids(path: Path, facts: dict[str, Any], key: str) -> list[str]:
    ids = facts.get(key, [])
    if not isinstance(ids, list) or not all(isinstance(i, str) for i in ids) or len(set(ids)) < len(ids):
        raise ValueError(f"{path}: {key} must be a list of different ids")
    for i in ids:
        if not i or "/" in i or "\\" in i or "\0" in i or i.startswith("."):
            raise ValueError(f"{path}: {key} must hold plain names, got {i!r}")
    return ids


def _fact(metadata: dict[str, Any], name: str, key: str) -> Any:
    entry = metadata.get(name)
    return entry.get(key) if isinstance(entry, dict) else None


def _times(path: Path, metadata: dict[str, Any], names: list[str]) -> dict[str, float]:
    """Time of each frame: time_id (else warp_id, in older captures) over the largest of all frames."""
    steps = {}
    for name in names:
        step = _fact(metadata, name, "time_id")
        step = _fact(metadata, name, "warp_id") if step is None else step
        if isinstance(step, bool) or not isinstance(step, int | float) or not 0 <= step < math.inf:
            raise ValueError(f"{path} has no time_id or warp_id for frame {name}: {step!r}")
        steps[name] = step
    last = max(steps.values()) or 1  # a single moment is time 0
    return {name: step / last for name, step in steps.items()}


@dataclass(frozen=True)
class _Files:
    """Where a frame's parts lie; None for what the capture does not have of it."""

    image: Path
    mask: Path | None
    depth: Path | None
    covisible: Path | None


def _find_files(root: Path, factor: int, train: Sequence[str], val: Sequence[str]) -> dict[str, _Files]:
    """Files of every frame: pictures all there, and masks of all training frames if there are masks at all."""
    rgb, size = root / "rgb", f"{factor}x"
    if not (rgb / size).is_dir():
        found = ", ".join(sorted(p.name for p in rgb.glob("*x"))) or "no size"
        raise ValueError(f"{rgb / size} is missing: {LAYOUT}; {rgb} has {found}")
    masks = next((p for p in (root / "resized_mask", root / "mask") if p.is_dir()), None)
    if masks is not None and not (masks / size).is_dir():
        raise ValueError(f"{masks / size} is missing: the pictures are {rgb / size}, masks must have their size")
    # Depth is resized to the picture, so the full size serves every factor.
    depths = [root / "depth" / s for s in (size, "1x")]
    files = {}
    for name in [*train, *val]:
        image = _first(rgb / size / f"{name}{ending}" for ending in (".png", ".jpg"))
        if image is None:
            raise ValueError(f"{rgb / size / name}.png is missing: dataset.json lists the frame")
        mask = None if masks is None else _first(masks / size / f"{name}{e}" for e in (".png.png", ".png"))
        files[name] = _Files(
            image,
            mask,
            _first(folder / f"{name}{ending}" for folder in depths for ending in (".npy", ".png")),
            _first([root / "covisible" / size / "val" / f"{name}.png"]),
        )
    for name in train:
        if masks is not None and files[name].mask is None:
            raise ValueError(f"{masks / size / name}.png.png is missing: every training frame needs its mask")
    return files


def _first(paths: Iterable[Path]) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


@dataclass(frozen=True)
class _Reader:
    """Reads frames.

    Attributes:
        cameras, lenses, files: Of each frame.
        train: Frames whose masks are perturbed.
        perturbation: What is done to them.
        metric_scale: Scene units in a metre where .npy depth is distance along the axis (iPhone); None where it is
            inverse depth already.
    """

    cameras: dict[str, Camera]
    lenses: dict[str, Lens]
    files: dict[str, _Files]
    train: frozenset[str]
    perturbation: MaskPerturbation
    metric_scale: float | None

    def read(self, name: str) -> Frame:
        files, lens, size = self.files[name], self.lenses[name], self.cameras[name].size
        mask = None if files.mask is None else undistort(images.read_mask(files.mask, size), lens)
        if mask is not None and name in self.train:
            mask = perturb(mask, self.perturbation, name)
        depth = None if files.depth is None else undistort(self._inverse_depth(files.depth, size), lens)
        covisible = None if files.covisible is None else undistort(images.read_mask(files.covisible, size), lens)
        return Frame(
            name,
            self.cameras[name],
            torch.from_numpy(undistort(images.read_image(files.image, size), lens)),
            None if mask is None else torch.from_numpy(mask),
            None if depth is None else torch.from_numpy(depth),
            None if covisible is None else torch.from_numpy(covisible),
        )

    def _inverse_depth(self, path: Path, size: tuple[int, int]) -> np.ndarray:
        values = images.read_depth(path, size)
        if self.metric_scale is None or path.suffix != ".npy":
            return values
        known = (values > 0) & (values != CLAMPED_DEPTH)
        metres = np.where(known, values, np.float32(np.nan))
        return 1.0 / (metres * np.float32(self.metric_scale))
