"""Depth as Depth Anything 3, VGGT and MoGe give it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from warpgs.data.exr import read_exr_channel
from warpgs.data.images import MAX_PIXELS, MAX_SIDE
from warpgs.data.loaders.listed import find_file
from warpgs.data.npz import names_of, read_npz
from warpgs.data.resized import inverse_of
from warpgs.files import read_array, read_bounded

from .checked import Results, Size

MAX_STRETCH = 1.06
"""Maximum ratio of the aspect ratios of depth and image: networks round sides to multiples of 14."""

MAX_FILE = 1 << 30
"""Maximum size of a file of one frame [bytes]."""


def read_depths(path: Path, names: Sequence[str], sizes: Sequence[Size]) -> Results:
    """[h, w] inverse depth of frames, in the network's resolution but the shape of the image; NaN where unknown.

    Args:
        path: An .npz file of Depth Anything 3, VGGT or SpatialTracker, or a folder of MoGe: <name>/depth.exr or .npy,
            or <name>.exr or .npy.
        names: Ids of all frames of the camera, by time.
        sizes: Width and height of each.

    Raises:
        ValueError: There or here, if the file of a frame is missing, damaged, or has other frames or another shape.
    """
    if path.is_dir():
        return Results(names, sizes, lambda name, size: _read_one(_file_of(path, name), size))
    key = next((name for name in ("depth", "depths") if name in names_of(path)), None)
    if key is None:
        raise ValueError(f"{path} has no array depth [N, H, W], as Depth Anything 3 and VGGT write it")
    depths = read_npz(path, (key,))[key]
    depths = depths[..., 0] if depths.ndim == 4 and depths.shape[3] == 1 else depths
    if depths.ndim != 3 or len(depths) != len(names):
        raise ValueError(
            f"{path}: {key} must be [N, H, W] of the camera's {len(names)} frames, got {list(depths.shape)}"
        )
    return Results([*depths], sizes, lambda depth, size: _inverse(path, depth, size))


def _read_one(file: Path, size: Size) -> Float[np.ndarray, "h w"]:
    return _inverse(file, _read_file(file), size)


def _file_of(folder: Path, name: str) -> Path:
    found = (find_file(place, stem, (".exr", ".npy")) for place, stem in ((folder / name, "depth"), (folder, name)))
    file = next((path for path in found if path is not None), None)
    if file is None:
        raise ValueError(f"{folder} has no depth of frame {name}: expected {name}/depth.exr or {name}.npy")
    return file


def _read_file(path: Path) -> Shaped[np.ndarray, "..."]:
    if path.suffix.lower() == ".npy":
        return read_array(path, MAX_PIXELS)
    return read_exr_channel(path, read_bounded(path, MAX_FILE), "Y")  # OpenCV's name of a single channel


def _inverse(path: Path, depth: Shaped[np.ndarray, "..."], size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    if depth.ndim != 2 or not 0 < min(depth.shape) <= max(depth.shape) <= MAX_SIDE:
        raise ValueError(f"{path}: depth must be one channel, [H, W], got shape {list(depth.shape)}")
    height, width = depth.shape
    stretch = width / height * size[1] / size[0]
    if max(stretch, 1.0 / stretch) > MAX_STRETCH:
        raise ValueError(f"{path}: depth of {width}×{height} pixels has not the shape of frames of {size[0]}×{size[1]}")
    longest = max(width, height) / max(size)
    return inverse_of(depth, (max(1, round(size[0] * longest)), max(1, round(size[1] * longest))))
