"""Whether a camera stands still, and what it sees where nothing moves."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from warpgs.data.sampling import evenly_spaced

from .images import read_images, resize_to_side

SIDE, NUM_CORNERS, MIN_CORNERS = 512, 400, 40
"""Longest side of the images that are compared [px], and maximum and minimum number of corners that are followed."""

QUALITY, SPACING = 0.001, 16
"""Strength of the weakest corner relative to the strongest, and distance between corners [px]: what moves must not have
them all because it has more texture than the walls behind it."""

MAX_SHIFT, MIN_STAYING, MIN_STILL = 0.75, 0.2, 0.9
"""Distance up to which a corner stays where it is [px], fraction of the corners that do so in a frame of a camera that
stands still, because things move before it, and fraction of such frames. Of 43 clips of DAVIS with a moving camera none
has 0.01; a clock or a title that is burned in has some corners, too."""

MIN_LIKELY = 0.1
"""Fraction of the corners that stay in the median frame, below which a camera cannot stand still."""

NUM_COMPARED, NUM_MEDIAN = 16, 31
"""Number of frames that are compared with the middle one, and that the background is the median of."""

BAND, UNCOUNTED = 16, 256
"""Rows whose median is computed together, and a level above all others."""

MIN_SEEN = 3
"""Number of frames that must see a place without motion for these alone to tell its background."""


def find_background(folder: Path, names: Sequence[str]) -> UInt8[np.ndarray, "H W 3"] | None:
    """[H, W, 3] the median over time of the frames <folder>/<name>.png; None if the camera moves."""
    if not stands_still(folder, names):
        return None
    return median(list(read_images(folder, evenly_spaced(names, NUM_MEDIAN))))


def stands_still(folder: Path, names: Sequence[str]) -> bool:
    """Whether enough corners stay where they are in nearly all frames."""
    staying = staying_corners(folder, names)
    return bool(staying) and float(np.mean(np.array(staying) >= MIN_STAYING)) >= MIN_STILL


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
    corners = cv2.goodFeaturesToTrack(middle, NUM_CORNERS, QUALITY, SPACING)
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


def median(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], static: Sequence[Bool[np.ndarray, "H W"]] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] the median over time, in bands of rows, so that it takes little more memory than the images.

    Args:
        images: [H, W, 3] of each frame.
        static: [H, W] what counts of each; where fewer than ``MIN_SEEN`` frames have something, and if None, all count.
    """
    found = np.empty_like(images[0])
    for row in range(0, len(found), BAND):
        rows = slice(row, row + BAND)
        values = np.array([image[rows] for image in images], np.int16)
        if static is not None:
            counts = np.array([mask[rows] for mask in static])
            values[~counts & (counts.sum(0) >= MIN_SEEN)] = UNCOUNTED
        values.sort(axis=0)
        count = (values < UNCOUNTED).sum(0, keepdims=True)
        middle = [np.take_along_axis(values, k, 0)[0] for k in ((count - 1) // 2, count // 2)]
        found[rows] = (sum(middle) / 2.0).round()
    return found
