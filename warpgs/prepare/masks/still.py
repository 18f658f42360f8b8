"""What moves before a camera that stands still: what differs from the background, its median over time.

Optical flow does not show objects of one flat colour, and noise looks like motion to it; differences from the
background show the former and not the latter. A difference counts beyond the noise of the frame, and beyond what an
edge that moves by a part of a pixel makes. Shadows only darken what they fall on: where the colour is the background's
times a factor, it counts only if motion confirms it. On 24 ray-traced frames, the intersection over union with what
moves is 0.87 instead of 0.96 by motion alone, because of shadows that are tinted; with objects of one flat colour 0.71
instead of 0.02; with noise of 6 levels 0.85 instead of 0.44.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.data.sampling import evenly_spaced_indices

from ..cameras.posed_frames import PosedFrames
from ..frames.images import brighten
from ..frames.parallel import map_frames
from ..frames.stillness import NUM_MEDIAN
from .motion import LIKELY, clean, find_dynamic, outline

NUM_NOISES, MIN_DIFFERENCE, EDGE = 6.0, 14.0, 0.75
"""Difference that counts, in standard deviations of the frame's noise, its minimum [levels], and the shift of edges
that does not count [px]."""

SHADOW, SAME_COLOR = 0.35, 0.06
"""Brightness in a shadow over that without it, and difference of chromaticity that one may have by noise."""

MIN_SEEN, NEAR = 3, 5
"""Number of frames that must see a place without motion for these alone to tell its background, and width of the square
that the region that differs is dilated with before it confirms motion [px]."""


def find_before_background(frames: PosedFrames, quiet: bool = True) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] true where each frame of a camera that stands still is dynamic."""
    images = brighten(frames.images)
    moving = find_dynamic(frames, quiet)
    some = evenly_spaced_indices(len(images), NUM_MEDIAN)
    background = median_where([images[k] for k in some], [~moving[k] for k in some])

    def find(k: int) -> np.ndarray:
        differs, is_shadow = difference(images[k], background)
        near = cv2.dilate((differs > LIKELY).astype(np.uint8), np.ones((NEAR, NEAR), np.uint8)) > 0
        return clean(outline(images[k], differs * ~is_shadow)) | (moving[k] & near)

    return map_frames(find, range(len(images)), "background", quiet)


def median_where(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], static: Sequence[Bool[np.ndarray, "H W"]]
) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] the median over time of what is static, or of everything where that is hardly ever seen."""
    seen = np.sum(static, axis=0) >= MIN_SEEN
    values = np.array(images, np.float32)
    values[~np.array(static) & seen] = np.nan
    return np.nanmedian(values, axis=0).round().astype(np.uint8)


def difference(
    image: UInt8[np.ndarray, "H W 3"], background: UInt8[np.ndarray, "H W 3"]
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """How surely an image differs from the background, and whether by its brightness alone.

    Returns:
        [H, W] in [0, 1], 0.5 where the difference begins to count; and [H, W] whether it may be a shadow, or where one
        was.
    """
    smooth, before = (cv2.GaussianBlur(i, (0, 0), 1.0).astype(np.float32) for i in (image, background))
    change = smooth - before
    change -= np.median(change, axis=(0, 1))  # exposure
    noise = 1.4826 * float(np.median(np.abs(change)))
    slopes = [np.abs(cv2.Sobel(before, -1, *axes)).max(-1) / 8.0 for axes in ((1, 0), (0, 1))]
    tolerance = max(MIN_DIFFERENCE, NUM_NOISES * noise) + EDGE * np.hypot(*slopes)
    ratio = (np.abs(change).max(-1) / tolerance) ** 4
    total, total_before = smooth.sum(-1) + 1.0, before.sum(-1) + 1.0
    tint = np.abs(smooth / total[..., None] - before / total_before[..., None]).max(-1)
    brightness = total / total_before
    is_shadow = (brightness > SHADOW) & (brightness < 1.0 / SHADOW) & (tint < SAME_COLOR)
    return (ratio / (1.0 + ratio)).astype(np.float32), is_shadow
