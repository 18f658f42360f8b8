"""Dynamic masks: the methods that find what moves, and the files that a preparation keeps the masks in."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from warpgs.data.images import read_mask
from warpgs.data.lens import undistort
from warpgs.files import read_json, write_json, write_png

from ..cameras.posed_frames import PosedFrames, load_posed_frames
from ..cameras.recovered import Cameras
from ..methods import DynamicMasks, Masker
from ..weights import SAM2, find_weights
from .motion import find_dynamic

WORKING_SIDE = 512
"""Longest side of the images that motion is found on [px]. Smaller images are enlarged, because superpixels and
outlines have sizes in pixels (hand video at 256×192: intersection over union 0.33, enlarged 0.79)."""

INDEX = "masks.json"
"""Index of the masks in their folder, with ``dynamic_fraction`` and ``undistorted``."""


def _sam2(frames: PosedFrames, weights: Path | None, quiet: bool) -> DynamicMasks:
    from .sam2 import track  # imports torch

    assert weights is not None
    return track(frames.images, find_dynamic(frames, quiet), weights, quiet)


MASKERS: dict[str, Masker | None] = {
    "motion": Masker(lambda frames, weights, quiet: find_dynamic(frames, quiet)),
    "sam2": Masker(_sam2, SAM2),
    "none": None,
}
"""Values of ``--masks`` apart from a folder. A new method is a new file and a line here."""


@dataclass(frozen=True)
class Masks:
    """Masks of all frames, in files <folder>/<name>.png.png with 0 = dynamic, as COLMAP reads them.

    Attributes:
        folder: Folder of the files; None if nothing is dynamic.
        dynamic_fraction: Fraction of the pixels that are dynamic.
        undistorted: Whether the masks belong to undistorted frames. COLMAP uses them with the frames all the same:
            features a few pixels from the outlines do no harm.
        estimated: Whether a method of ``MASKERS`` found them, instead of the user giving them.
    """

    folder: Path | None = None
    dynamic_fraction: float = 0.0
    undistorted: bool = False
    estimated: bool = False

    @staticmethod
    def load(folder: Path) -> "Masks":
        """The masks that ``write_masks`` wrote."""
        index = read_json(folder / INDEX)
        return Masks(folder, float(index["dynamic_fraction"]), bool(index["undistorted"]))

    def read_dynamic(self, cameras: Cameras) -> list[Bool[np.ndarray, "H W"]]:
        """[H, W] the dynamic mask of each undistorted frame of the cameras, in the size of the lens.

        Raises:
            ValueError: If a file was damaged since it was written.
        """
        lens, size = cameras.lens, (cameras.lens.width, cameras.lens.height)
        if self.folder is None:
            return [np.zeros(size[::-1], bool) for _ in cameras.names]
        masks = (~read_mask(self.folder / f"{name}.png.png", size) for name in cameras.names)
        return [mask if self.undistorted else undistort(mask, lens) for mask in masks]


def mask_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """The files that ``write_masks`` writes."""
    return [folder / INDEX, *(folder / f"{name}.png.png" for name in names)]


def write_masks(
    folder: Path, names: Sequence[str], dynamic: Sequence[Bool[np.ndarray, "H W"]], undistorted: bool = False
) -> str:
    """Writes the masks of the frames; returns a summary.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    for name, mask in zip(names, dynamic, strict=True):
        write_png(folder / f"{name}.png.png", (~mask).astype(np.uint8) * 255)
    fraction = float(np.mean([mask.mean() for mask in dynamic]))
    write_json(folder / INDEX, {"dynamic_fraction": fraction, "undistorted": undistorted})
    return f"{fraction:.1%} of the pixels move"


def find_masks(
    images: Path, cameras: Cameras, masker: Masker, weights: Path | None, *, half_size: bool, quiet: bool
) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] the dynamic mask of each frame of the cameras, in the size of the lens.

    Args:
        images: Folder of the frames <name>.png.
        cameras: Cameras of the frames.
        masker: How to find what moves.
        weights: Folder with the networks' weights; None for the Hugging Face cache.
        half_size: Whether to find it on images of half the usual size.
        quiet: Whether to show no progress.
    """
    folder = find_weights(masker.network, weights)
    side = WORKING_SIDE // 2 if half_size else WORKING_SIDE
    masks = masker.find(load_posed_frames(images, cameras, side), folder, quiet)
    size = cameras.lens.width, cameras.lens.height
    return [cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_CUBIC) > 0.5 for mask in masks]
