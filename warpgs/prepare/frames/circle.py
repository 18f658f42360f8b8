"""The circular image of a fisheye lens in the frames of a video, found before the lens is known."""

from collections.abc import Iterable, Sequence
from functools import reduce
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from warpgs.data.image_circle import MAX_BLACK, MIN_LIT, RING
from warpgs.data.masks import nearest_pixels
from warpgs.data.sampling import evenly_spaced

from .images import read_images

NUM_FRAMES = 16
"""Number of frames that are looked at."""

MIN_SURROUND = 0.02
"""Minimum part of a frame that is black around the circle."""

MARGIN = 0.02
"""Part of the circle's radius that is left away, because lenses blur and darken their rim."""


def circle_in(images: Iterable[UInt8[np.ndarray, "H W 3"]]) -> Bool[np.ndarray, "H W"] | None:
    """[H, W] true inside the circular image of a fisheye, without its rim; None if no frame shows one."""
    brightest = reduce(np.maximum, (image.max(2) for image in images))
    lit = cv2.erode((brightest > MAX_BLACK).astype(np.uint8), np.ones((3, 3), np.uint8))
    points = cv2.findNonZero(lit)
    if points is None:
        return None
    (x, y), radius = cv2.minEnclosingCircle(cv2.convexHull(points))
    height, width = lit.shape
    distance = np.hypot(*np.meshgrid(np.arange(width) - x, np.arange(height) - y))
    ring = lit[(distance > RING * radius) & (distance <= radius)]
    if (distance > radius).mean() < MIN_SURROUND or not ring.size or ring.mean() < MIN_LIT:
        return None
    return distance <= (1.0 - MARGIN) * radius


def spread(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], shown: Bool[np.ndarray, "H W"]
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The images with the colours of the circle's rim around it.

    The rim would be the strongest edge of an image, and stays where it is while everything moves.
    """
    nearest, _ = nearest_pixels(shown)
    return [image.reshape(-1, 3)[nearest].reshape(image.shape) for image in images]


def circle_of(folder: Path, names: Sequence[str]) -> Bool[np.ndarray, "H W"] | None:
    """The same of the frames <folder>/<name>.png."""
    return circle_in(read_images(folder, evenly_spaced(names, NUM_FRAMES)))
