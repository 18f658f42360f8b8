"""Checks the masks of a capture by themselves."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from .capture import Frame
from .dynamic_regions import MIN_FRAMES, MIN_KNOWN_FRACTION, dynamic_regions, is_cut, unknown_depth
from .findings import Finding

MAX_DYNAMIC_FRACTION = 0.4
"""Mean fraction of dynamic pixels; masks with more are rarely correct."""


class DynamicCounts(NamedTuple):
    """Numbers of dynamic regions, of those that the border cuts off, of dynamic pixels, and of those with depth.

    Attributes:
        fraction: Dynamic pixels as a fraction of all pixels of the frame.
    """

    regions: int
    cut: int
    pixels: int
    fraction: float
    with_depth: int


def dynamic_counts(frame: Frame) -> DynamicCounts:
    """Counts what the mask of a frame that has one marks as dynamic."""
    assert frame.static_mask is not None
    regions, is_dynamic = dynamic_regions(frame), ~frame.static_mask
    with_depth = 0 if frame.inverse_depth is None else int((frame.inverse_depth.isfinite() & is_dynamic).sum())
    pixels = int(is_dynamic.sum())
    return DynamicCounts(len(regions), sum(map(is_cut, regions)), pixels, pixels / is_dynamic.numel(), with_depth)


def check_masks(frames: list[DynamicCounts]) -> Iterator[Finding]:
    """Checks the masks of training frames."""
    dynamic = [frame.fraction for frame in frames]
    if max(dynamic) == 0.0:
        yield Finding("warning", "masks", "the masks mark nothing as dynamic")
    elif min(dynamic) == 1.0:
        yield Finding("error", "masks", "the masks mark everything as dynamic: 0 must mean dynamic, 255 static")
    else:
        mean = float(np.mean(dynamic))
        text = f"the masks mark {mean:.1%} of the pixels as dynamic on average, {max(dynamic):.1%} at most"
        yield Finding("warning" if mean > MAX_DYNAMIC_FRACTION else "note", "masks", text)
        yield from _dynamic_depth(frames)


def _dynamic_depth(frames: list[DynamicCounts]) -> Iterator[Finding]:
    """Whether something tells the depth of what moves in the training frames."""
    is_known = sum(f.with_depth for f in frames) >= MIN_KNOWN_FRACTION * sum(f.pixels for f in frames)
    num_whole = sum(f.cut < f.regions for f in frames)
    if any(f.regions for f in frames) and num_whole < MIN_FRAMES and not is_known:
        yield Finding("warning", "depth", unknown_depth(sum(f.cut > 0 for f in frames), len(frames)))
