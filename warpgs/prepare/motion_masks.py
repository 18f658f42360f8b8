"""Masks of what moves, without any network: by what camera motion does not explain.

Every frame is triangulated against its neighbours (``dense``) and compared with far ones (``revisits``). What was found
on textured pixels spreads over superpixels of all frames (``segments``), and GrabCut draws the outline.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from .dense import PosedFrames, filled
from .parallel import each
from .revisits import NUM_AGREEING, Revisits
from .segments import Graph, Segments, segment

MIDDLE_GREY = 0.45
"""Median lightness that dark footage is lifted to, so that dark cloth has texture."""

MIN_PART = 0.002
"""Share of the picture that a moving part must have; smaller ones are noise."""

MIN_HOLE = 0.003
"""Share of the picture; smaller holes in a moving part are filled."""

CERTAIN, LIKELY, POSSIBLE = 0.85, 0.5, 0.15
"""Shares of motion from which GrabCut is told moving, probably moving and probably static; below, static."""

OWN_VOTE, VOTES = 1.5, (1.0, 0.8, 0.6)
"""Weight of a frame's own mask and of those one, two and three frames off, to either side."""

OUTLINE_WIDTH = 0.006
"""What is moving grows by this share of the picture's width: blur and soft shadow around a body move with it."""


def lift(images: Sequence[UInt8[np.ndarray, "H W 3"]]) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The pictures with one gamma curve that brings their median to middle grey."""
    middle = np.median([np.median(image[::4, ::4]) for image in images]) / 255.0
    gamma = np.clip(np.log(MIDDLE_GREY) / np.log(np.clip(middle, 0.02, 0.98)), 0.3, 1.5)
    curve = (255.0 * (np.arange(256) / 255.0) ** gamma).round().astype(np.uint8)
    return [cv2.LUT(image, curve) for image in images]


@dataclass(frozen=True)
class _Finder:
    footage: PosedFrames
    labs: list[np.ndarray]
    revisits: Revisits

    def found(self, frame: int) -> tuple[Segments, tuple[np.ndarray, np.ndarray] | None]:
        """A frame's superpixels with the evidence on them, and where its pixels go in the next frame."""
        evidence = self.revisits.evidence(frame)
        texture = _texture(self.labs[frame])
        # A moving body is at odds with the neighbours too; where they fit well, a far mismatch is doubted.
        odds = np.clip(np.nan_to_num(evidence.residual, nan=1.5) - 0.5, 0.15, 1.0)
        moving = (1.0 - evidence.agreement) * (evidence.witnesses >= NUM_AGREEING) * odds
        static = texture * evidence.agreement
        segments = segment(self.labs[frame], filled(evidence.inverse_depth), static, texture * moving)
        return segments, self._carried(frame) if frame + 1 < len(self.labs) else None

    def _carried(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Flat places of pixels that flow carries to the next frame, and theirs there."""
        x, y, seen = self.footage.flows.places(frame, frame + 1)
        height, width = seen.shape
        column, row = x.round().astype(np.int64), y.round().astype(np.int64)
        seen = seen & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixels = seen.ravel().nonzero()[0]
        return pixels.astype(np.int32), (row * width + column).ravel()[pixels].astype(np.int32)


def _texture(lab: np.ndarray) -> Float[np.ndarray, "H W"]:
    """[H, W] in [0, 1], whether a pixel has texture enough to be recognised."""
    lightness = cv2.GaussianBlur(lab[..., 0], (0, 0), 1.0).astype(np.float32)
    slope = np.hypot(cv2.Sobel(lightness, -1, 1, 0), cv2.Sobel(lightness, -1, 0, 1)) / 8.0
    return np.clip((slope - 0.8) / 1.5, 0.0, 1.0)


def find_moving(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], footage: PosedFrames, quiet: bool = True
) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] true where each picture moves.

    Args:
        images: [H, W, 3] lifted pictures.
        footage: Of the same pictures.
        quiet: Whether to show no progress.
    """
    frames = range(len(images))
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    labs = [cv2.cvtColor(image, cv2.COLOR_RGB2LAB) for image in images]
    found = each(_Finder(footage, labs, Revisits(footage, grey)).found, frames, "motion", quiet)
    segments, carried = [f for f, _ in found], [c for _, c in found if c is not None]
    shares = Graph(segments, carried).motion()
    outlines = each(lambda k: outline(images[k], shares[k]), frames, "outlines", quiet)
    return [tidy(moving) for moving in vote(outlines, carried)]


def vote(
    masks: Sequence[Bool[np.ndarray, "H W"]], carried: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[Bool[np.ndarray, "H W"]]:
    """Each pixel's majority over its own and three frames to both sides, where optical flow carries it.

    Args:
        masks: [H, W] of each frame.
        carried: Of each frame but the last, flat places of pixels and theirs in the next.
    """
    shape, size = masks[0].shape, masks[0].size
    votes = [np.where(mask.ravel(), OWN_VOTE, -OWN_VOTE) for mask in masks]
    for towards_next in (True, False):
        steps = []
        for here, there in carried:
            step = np.full(size + 1, size)  # one place more, for pixels that are lost
            step[here if towards_next else there] = there if towards_next else here
            steps.append(step)
        for k in range(len(masks)):
            place, other = np.arange(size), k
            for weight in VOTES:
                if not 0 <= (other if towards_next else other - 1) < len(steps):
                    break
                place = steps[other if towards_next else other - 1][place]
                other += 1 if towards_next else -1
                opinion = np.where(np.append(masks[other].ravel(), False)[place], weight, -weight)
                votes[k] += np.where(place < size, opinion, 0.0)
    return [(v > 0).reshape(shape) for v in votes]


def outline(image: UInt8[np.ndarray, "H W 3"], share: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The moving region of a picture, its outline drawn by GrabCut where colours tell it.

    Args:
        image: [H, W, 3].
        share: [H, W] of motion in [0, 1].
    """
    share = cv2.GaussianBlur(share.astype(np.float32), (0, 0), 3.0)
    likely = share > LIKELY
    if not likely.any() or likely.all():
        return likely
    hints = np.full(share.shape, cv2.GC_BGD, np.uint8)
    for threshold, hint in ((POSSIBLE, cv2.GC_PR_BGD), (LIKELY, cv2.GC_PR_FGD), (CERTAIN, cv2.GC_FGD)):
        hints[share > threshold] = hint
    cv2.setRNGSeed(0)  # its colour clusters start at random
    cv2.grabCut(image, hints, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    moving = (hints == cv2.GC_FGD) | (hints == cv2.GC_PR_FGD)
    # A body whose colours are the background's as well loses all of itself: then the evidence alone decides.
    if moving.sum() < 0.5 * likely.sum():
        moving = likely
    return moving


def tidy(moving: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The region without specks and pinholes, and grown by the width of soft outlines."""
    area, width = moving.size, moving.shape[1]
    moving = _without_small(moving, MIN_PART * area)
    moving = ~_without_small(~moving, MIN_HOLE * area)
    radius = round(OUTLINE_WIDTH * width)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(moving.astype(np.uint8), disc) > 0


def _without_small(region: np.ndarray, least: float) -> np.ndarray:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return large[labels]
