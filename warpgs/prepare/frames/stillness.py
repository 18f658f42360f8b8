"""Whether a camera stands still."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from warpgs.data.sampling import evenly_spaced

from .images import read_images, resize_to_side

SIDE, NUM_CORNERS, MIN_CORNERS = 512, 400, 40
"""Longest side of the images that are compared [px], and maximum and minimum number of corners that are followed."""

MAX_SHIFT = 0.75
"""Distance up to which a corner stays where it is [px]."""

MIN_LIKELY = 0.25
"""Fraction of the corners that stay in the median frame, below which a camera cannot stand still."""

NUM_COMPARED, NUM_MEDIAN = 16, 31
"""Number of frames that are compared with the middle one, and that the background is the median of."""


def require_still(folder: Path, names: Sequence[str]) -> None:
    """Raises ValueError if a camera that is said to stand still moves."""
    staying = staying_corners(folder, names)
    if staying and (fraction := float(np.median(staying))) < MIN_LIKELY:
        raise ValueError(
            f"only {fraction:.0%} of the corners stay where they are: the camera is not still; try another --camera"
        )


def staying_corners(folder: Path, names: Sequence[str]) -> list[float]:
    """Fraction of the middle frame's corners that are where they were in each of some frames; none without texture."""
    middle, *others = _greys(folder, [names[len(names) // 2], *evenly_spaced(names, NUM_COMPARED)])
    corners = cv2.goodFeaturesToTrack(middle, NUM_CORNERS, 0.01, 7)
    if corners is None or len(corners) < MIN_CORNERS:
        return []
    return [_staying(middle, other, corners) for other in others]


def _greys(folder: Path, names: Sequence[str]) -> list[UInt8[np.ndarray, "H W"]]:
    images = read_images(folder, names)
    return [cv2.cvtColor(resize_to_side(image, SIDE, max_factor=1.0), cv2.COLOR_RGB2GRAY) for image in images]


def _staying(a: UInt8[np.ndarray, "H W"], b: UInt8[np.ndarray, "H W"], corners: np.ndarray) -> float:
    """Fraction of the corners of a that are in the same place in b."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None)
    shifts = np.linalg.norm((moved - corners).reshape(-1, 2), axis=1)
    return float(((shifts < MAX_SHIFT) & (found.ravel() > 0)).mean())
