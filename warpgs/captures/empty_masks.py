"""Masks that mark nothing although what others mark cannot have left the image."""

from collections.abc import Iterator, Mapping
from itertools import groupby

import numpy as np

from warpgs.data.capture import Capture

from .findings import Finding
from .masks_check import DynamicCounts, dynamic_counts
from .motion_check import are_comparable

MIN_RELATIVE_SIZE = 0.5
"""Minimum fraction of dynamic pixels in the frame next to an empty mask, relative to the median of the masks that are
not empty: what hides or leaves becomes smaller first."""


def untrusted_masks(capture: Capture) -> list[str]:
    """Training frames whose masks are not to be trusted, in temporal order; none where masks are not used.

    Raises:
        ValueError: If a frame is damaged.
    """
    if capture.assumption != "masks":
        return []
    frames = capture.frames(capture.train)
    return wrongly_empty(capture, {f.name: dynamic_counts(f) for f in frames if f.static_mask is not None})


def check_empty_masks(capture: Capture, masks: Mapping[str, DynamicCounts]) -> Iterator[Finding]:
    """Names the masks that are not trusted; the arguments are those of ``wrongly_empty``."""
    if found := wrongly_empty(capture, masks):
        text = (
            f"{len(found)} of {len(masks)} masks mark nothing, such as that of {found[0]}, though something marked "
            "whole just before or after cannot have left the image: they are not trusted, so of these frames training "
            "compares only the joint image (not with the preset paper)"
        )
        yield Finding("warning", "masks", text)


def wrongly_empty(capture: Capture, masks: Mapping[str, DynamicCounts]) -> list[str]:
    """Frames whose masks mark nothing, next in time to one with something that the image border does not cut off.

    Successive frames with empty masks are doubted together. Frames are next to each other only if their cameras look in
    similar directions.

    Args:
        capture: The capture.
        masks: Counts of the dynamic pixels of some of its training frames, by name.

    Returns:
        Their names in temporal order.
    """
    marked = [counts.fraction for counts in masks.values() if counts.regions]
    if not marked:
        return []
    cameras, least = capture.cameras, MIN_RELATIVE_SIZE * float(np.median(marked))
    names = sorted(masks, key=lambda name: cameras[name].time)
    runs = [list(run) for _, run in groupby(names, key=lambda name: masks[name].regions == 0)]
    found: list[str] = []
    for k, run in enumerate(runs):
        edges = [(run[0], runs[k - 1][-1])] if k > 0 else []
        edges += [(run[-1], runs[k + 1][0])] if k + 1 < len(runs) else []
        neighbours = [masks[other] for name, other in edges if are_comparable(cameras[name], cameras[other])]
        if masks[run[0]].regions == 0 and any(n.cut < n.regions and n.fraction >= least for n in neighbours):
            found += run
    return found
