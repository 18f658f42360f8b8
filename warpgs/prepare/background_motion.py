"""What does not move with the background, before any camera is known.

The camera that follows something keeps it in the image, while the background passes: the features of what is followed
have the longest tracks, and structure from motion places the cameras relative to it. Epipolar geometry does not tell,
because one that fits both usually exists. The background, however, is most of the image, and between neighbouring
frames one homography, that of its dominant plane or of what is far away, explains nearly all of it: its
outliers are masked in the first pass. Parts of the static foreground are masked as well, which only costs some
features.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from .flow import Flows
from .parallel import map_frames

SIDE = 128
"""Longest side of the images that are compared [px]."""

OFFSETS = (-2, -1, 1, 2)
"""Frames that a frame is compared with."""

SPACING = 3
"""Distance of the pixels that the homography is fitted to [px]; evenly, so that area counts and not texture."""

INLIER = 0.375
"""Distance from the homography within which a pixel supports it [px]."""

MIN_PIXELS = 50
"""Minimum number of pixels to fit a homography to."""

MIN_DISTANCE, MIN_RELATIVE = 0.75, 0.2
"""Distance from the homography [px], and relative to the displacement that it predicts, beyond which a pixel is off."""

MARGIN = 3
"""Width of the square that the region is dilated with [px]."""

MAX_FRACTION = 0.4
"""Fraction of a frame above which no plane dominates it, and nothing of it counts as off."""


def off_background(images: Sequence[UInt8[np.ndarray, "H W 3"]], quiet: bool = True) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] true where each frame does not move with its background.

    Args:
        images: [H, W, 3] of every frame, with the longest side of ``SIDE``.
        quiet: Whether to show no progress.
    """
    flows = Flows(images)

    def find(frame: int) -> np.ndarray:
        others = [frame + offset for offset in OFFSETS if 0 <= frame + offset < len(images)]
        votes = [vote for other in others if (vote := _is_off(flows, frame, other)) is not None]
        flows.release(frame)
        seen = np.sum([~np.isnan(vote) for vote in votes], axis=0)
        off = 2 * np.nansum(votes, axis=0) > seen if votes else np.zeros(flows.x.shape, bool)
        off = cv2.dilate(off.astype(np.uint8), np.ones((MARGIN, MARGIN), np.uint8)) > 0
        return off if off.mean() < MAX_FRACTION else np.zeros_like(off)

    return map_frames(find, range(len(images)), "background", quiet)


def _is_off(flows: Flows, frame: int, other: int) -> Float[np.ndarray, "H W"] | None:
    """[H, W] 1 where a pixel is off the homography to another frame, NaN where it is not found there."""
    x, y, visible = flows.track(frame, other)
    found, start = np.stack([x, y], -1), np.stack([flows.x, flows.y], -1)
    sampled = np.zeros_like(visible)
    sampled[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING] = True
    sampled &= visible
    if sampled.sum() < MIN_PIXELS:
        return None
    homography, _ = cv2.findHomography(start[sampled], found[sampled], cv2.USAC_MAGSAC, INLIER)
    if homography is None:
        return None
    predicted = cv2.perspectiveTransform(start.reshape(1, -1, 2), homography).reshape(start.shape)
    distance, displacement = (np.linalg.norm(v, axis=-1) for v in (found - predicted, predicted - start))
    off = (distance > MIN_DISTANCE) & (distance > MIN_RELATIVE * displacement)
    return np.where(visible, off.astype(np.float32), np.float32(np.nan))
