"""What does not move with the background, before any camera is known.

The camera that follows something keeps it in the image, while the background passes: the features of what is followed
have the longest tracks, and structure from motion places the cameras relative to it. Epipolar geometry does not tell,
because one that fits both usually exists. The background, however, is most of the image, and between neighbouring
frames one homography, that of its dominant plane or of what is far away, explains nearly all of it: its outliers are
masked in the first pass. Where it passes slowly, frames farther apart show them. Parts of the static foreground are
masked as well, which only costs some features.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..frames.flow import Flows
from ..frames.parallel import map_frames

SIDE = 128
"""Longest side of the images that are compared [px]."""

STEPS, MIN_OFF = (1, 2, 4, 8), 0.08
"""Frames one and two steps away, in both directions, are compared; the next longer step as well if less than this
fraction of the frame is off: what moves slowly has hardly left its place after one frame."""

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
        off = np.zeros(flows.x.shape, bool)
        for step in STEPS:
            more = off | _off_at(flows, frame, step)
            if more.mean() >= MAX_FRACTION:
                break
            off = more
            if off.mean() >= MIN_OFF:
                break
        flows.release(frame)
        return off

    return map_frames(find, range(len(images)), "background", quiet)


def _off_at(flows: Flows, frame: int, step: int) -> Bool[np.ndarray, "H W"]:
    """[H, W] true where most of the frames one and two steps away see a pixel off their homographies."""
    others = [frame + count * step for count in (-2, -1, 1, 2) if 0 <= frame + count * step < len(flows.planes)]
    votes = [vote for other in others if (vote := _is_off(flows, frame, other)) is not None]
    seen = np.sum([~np.isnan(vote) for vote in votes], axis=0)
    against = np.nansum(votes, axis=0)
    # Where the image moves on by many pixels, flow to a single frame may err.
    off = (2 * against > seen) & (against >= min(step, 2)) if votes else np.zeros(flows.x.shape, bool)
    return cv2.dilate(off.astype(np.uint8), np.ones((MARGIN, MARGIN), np.uint8)) > 0


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
