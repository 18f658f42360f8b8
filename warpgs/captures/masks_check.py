"""Checks the masks of a capture by themselves."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from warpgs.data.capture import Capture
from warpgs.data.dynamic_regions import MIN_FRAMES, MIN_KNOWN_FRACTION, DynamicCounts, unknown_depth
from warpgs.data.empty_masks import wrongly_empty

from .findings import Finding
from .motion_check import Motion, confirm_masks

MAX_DYNAMIC_FRACTION = 0.4
"""Mean fraction of dynamic pixels; masks with more are rarely correct."""

MAX_USABLE_FRACTION = 0.9
"""The same of masks that are inverted or hold something else, unless the images show that so much moves."""


def are_suspect(masks: Sequence[DynamicCounts]) -> bool:
    """Whether some masks mark nothing as dynamic, or all more than masks that are correct usually do."""
    fractions = [mask.fraction for mask in masks]
    return not all(mask.regions for mask in masks) or float(np.mean(fractions)) > MAX_DYNAMIC_FRACTION


def check_masks(masks: Sequence[DynamicCounts], capture: Capture, motions: Sequence[Motion]) -> Iterator[Finding]:
    """How much the masks of training frames mark as dynamic.

    Args:
        masks: Counts of at least one frame.
        capture: Their capture.
        motions: Motion between some of its frames, which may show that nearly everything moves indeed.
    """
    meaning, mean = capture.conventions.masks, float(np.mean([mask.fraction for mask in masks]))
    largest = max(mask.fraction for mask in masks)
    if largest == 0.0:
        text = f"the masks mark nothing as dynamic: {meaning}; train a scene without motion with --assume static"
        yield Finding("warning", "masks", text)
        return
    whole = min(mask.fraction for mask in masks) == 1.0
    marked = "everything" if whole else f"{mean:.1%} of the pixels"
    text = f"the masks mark {marked} as dynamic" + ("" if whole else f" on average, {largest:.1%} at most")
    is_doubtful = mean > MAX_USABLE_FRACTION and not capture.estimated_masks and not confirm_masks(motions)
    if whole or is_doubtful:
        text += f": {meaning}, and instance ids are not understood; if nearly everything moves, use --assume dynamic"
        yield Finding("error", "masks", text)
    else:
        yield Finding("warning" if mean > MAX_DYNAMIC_FRACTION else "note", "masks", text)


def check_dynamic_depth(frames: Sequence[DynamicCounts]) -> Iterator[Finding]:
    """Whether something tells the depth of what moves in the training frames."""
    is_known = sum(f.with_depth for f in frames) >= MIN_KNOWN_FRACTION * sum(f.pixels for f in frames)
    num_whole = sum(f.cut < f.regions for f in frames)
    if any(f.regions for f in frames) and num_whole < MIN_FRAMES and not is_known:
        yield Finding("warning", "depth", unknown_depth(sum(f.cut > 0 for f in frames), len(frames)))


def check_empty_masks(capture: Capture, masks: Mapping[str, DynamicCounts]) -> Iterator[Finding]:
    """Names the masks that are not trusted; the arguments are those of ``wrongly_empty``."""
    if found := wrongly_empty(capture.cameras, masks):
        text = (
            f"{len(found)} of {len(masks)} masks mark nothing, such as that of {found[0]}, though something marked "
            "whole just before or after cannot have left the image: they are not trusted, so of these frames training "
            "compares only the joint image (not with the preset paper)"
        )
        yield Finding("warning", "masks", text)
