"""Masks that mark nothing although what others mark cannot have left the image."""

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from warpgs.cameras import Camera, are_comparable

from .dynamic_regions import DynamicCounts

MIN_RELATIVE_SIZE = 0.5
"""Minimum fraction of dynamic pixels in the frame next to an empty mask, relative to the median of the masks that are
not empty: what hides or leaves becomes smaller first."""


def wrongly_empty(cameras: Mapping[str, Camera], masks: Mapping[str, DynamicCounts]) -> list[str]:
    """Frames whose masks mark nothing, next in time to one with something that the image border does not cut off.

    Successive frames with empty masks are doubted together. Frames are next to each other only if one camera took them,
    in similar directions.

    Args:
        cameras: The camera of each frame, by name.
        masks: Counts of the dynamic pixels of some of the training frames, by name.

    Returns:
        Their names, of one camera after the other, in temporal order.
    """
    marked = [counts.fraction for counts in masks.values() if counts.regions]
    if not marked:
        return []
    least = MIN_RELATIVE_SIZE * float(np.median(marked))
    names = sorted(masks, key=lambda name: (cameras[name].id, cameras[name].time))
    videos = [[*video] for _, video in groupby(names, key=lambda name: cameras[name].id)]
    return [name for video in videos for name in _of_video(video, cameras, masks, least)]


def _of_video(
    names: Sequence[str], cameras: Mapping[str, Camera], masks: Mapping[str, DynamicCounts], least: float
) -> list[str]:
    """The frames of one camera, in temporal order, that ``wrongly_empty`` finds.

    Args:
        names: Names of its frames in temporal order.
        cameras: See there.
        masks: See there.
        least: Minimum fraction of dynamic pixels next to an empty mask.
    """
    runs = [list(run) for _, run in groupby(names, key=lambda name: masks[name].regions == 0)]
    found: list[str] = []
    for k, run in enumerate(runs):
        edges = [(run[0], runs[k - 1][-1])] if k > 0 else []
        edges += [(run[-1], runs[k + 1][0])] if k + 1 < len(runs) else []
        neighbours = [masks[other] for name, other in edges if are_comparable(cameras[name], cameras[other])]
        if masks[run[0]].regions == 0 and any(n.cut < n.regions and n.fraction >= least for n in neighbours):
            found += run
    return found
