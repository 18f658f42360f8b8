"""Masks of objects as SAM 2 and SAM 3 give them: what is of an object is dynamic."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped

from warpgs.data.images import decode, indices_of
from warpgs.data.loaders.listed import find_file
from warpgs.data.npz import names_of, read_npz
from warpgs.data.resized import check_shape, read_resized_mask, resize_mask

from .checked import Results, Size

ARRAYS = ("masks", "out_binary_masks")
"""Names of the array of masks: [F, H, W], or with axes of objects before the last two."""

MAX_ID = 127
"""Largest value of a file of 8 bits that is dark everywhere; if something is brighter than 1, it shows ids."""

MAX_CHROMA = 64
"""Difference of a pixel's channels up to which it is grey, as images that were compressed are."""


def read_object_mask(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """True where a mask file is dynamic, resized to ``size`` (width, height): any part of a pixel is.

    A PNG file with a palette of colours holds ids of objects, and 0 where static, whatever the colours are; any other
    one is 0 where dynamic.

    Raises:
        ValueError: If it is damaged, of another shape, or seems to hold ids without a palette.
    """
    ids = indices_of(path)
    if ids is None:
        _refuse_ids(path, decode(path))
        return ~read_resized_mask(path, size)
    check_shape(path, "the mask", (ids.shape[1], ids.shape[0]), size)
    return ~resize_mask(ids == 0, size)


def _refuse_ids(path: Path, stored: Shaped[np.ndarray, "H W ..."]) -> None:
    """Raises ValueError if a file without a palette seems to have ids of objects, by levels or by colours."""
    levels = np.unique(stored[..., 0] if stored.ndim == 3 else stored)
    has_colors = stored.ndim == 3 and stored.shape[2] > 2 and int(np.ptp(stored[..., :3], axis=2).max()) > MAX_CHROMA
    if has_colors or 1 < levels[-1] <= MAX_ID:
        what = "colours" if has_colors else f"levels of {levels[0]} to {levels[-1]}"
        raise ValueError(
            f"{path} has {what}, but no palette that says which object has which id: store it with a palette, or with "
            "0 where something moves and 255 elsewhere"
        )


def read_masks(path: Path, names: Sequence[str], sizes: Sequence[Size]) -> Results:
    """[H, W] what is dynamic in frames, in their size.

    Args:
        path: An .npz file with the masks of all frames; or a folder with a PNG or .npz file of each, named like it.
        names: Ids of all frames of the camera, by time.
        sizes: Width and height of each.

    Raises:
        ValueError: There or here, if there is no mask of a frame, or it is damaged, of other frames or another shape.
    """
    if not path.is_dir():
        masks = _read(path)
        if masks.ndim < 3 or len(masks) != len(names):
            raise ValueError(
                f"{path}: masks must be [N, H, W] of the camera's {len(names)} frames, got {list(masks.shape)}"
            )
        return Results([*masks], sizes, lambda mask, size: _joined(path, mask, size))
    return Results(names, sizes, lambda name, size: _read_one(path, name, size))


def _read_one(folder: Path, name: str, size: Size) -> Bool[np.ndarray, "H W"]:
    file = find_file(folder, name, (".png", ".png.png", ".npz"))
    if file is None:
        raise ValueError(f"{folder} has no mask of frame {name}: expected {name}.png or {name}.npz")
    return read_object_mask(file, size) if file.suffix.lower() == ".png" else _joined(file, _read(file), size)


def _read(path: Path) -> Shaped[np.ndarray, "..."]:
    key = next((name for name in ARRAYS if name in names_of(path)), None)
    if key is None:
        raise ValueError(f"{path} has no array {' or '.join(ARRAYS)}")
    return read_npz(path, (key,))[key]


def _joined(path: Path, mask: Shaped[np.ndarray, "..."], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """What is of any object; logits are of one where positive."""
    if mask.ndim < 2 or 0 in mask.shape[-2:]:
        raise ValueError(f"{path}: a mask must be [H, W], or [objects, H, W], got {list(mask.shape)}")
    check_shape(path, "the mask", (mask.shape[-1], mask.shape[-2]), size)
    is_object = np.any(mask.reshape(-1, *mask.shape[-2:]) > 0, axis=0)
    return ~resize_mask(np.logical_not(is_object), size)
