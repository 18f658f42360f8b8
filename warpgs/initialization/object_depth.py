"""Depth of dynamic objects from their size.

One camera does not determine how far away something is that moves: twice as large, twice as far away and twice as fast
looks the same. But the distance of an object that keeps its size is inversely proportional to the size at which it is
seen, and the factor is bounded, because the object hides the static surfaces around it. Most objects stand on something
or come close to it at least once, so the largest factor that the bound allows is a good one. Objects that the image
border cuts off in most frames have no size; where others have one, they get the depth of their surroundings.

The depth of a network has the right order of magnitude, and misplaces each object as a whole by an amount that changes
with time. Both depths are averaged then.
"""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.views.views import Views

from .averaged_depth import average_depths
from .depth_by_size import depth_by_size
from .dynamic_points import is_depth_known
from .objects import find_all_objects, num_cut_off

SIZE_ERROR = 0.02
"""Relative error of a capture's depth at the sparse points at which it and depth by size have the same weight; chosen
on two captures (docs/design/object-depth.md)."""

MIN_ERROR = 0.016
"""Relative error of a capture's depth at the sparse points up to which it stays as it is."""


class ObjectDepth(NamedTuple):
    """What is known about the depth of dynamic objects by their size.

    Attributes:
        num_views: Number of views in which objects were given a depth or moved.
        num_cut: Number of views in which the image border cuts objects off, if nothing tells the depth of any, because
            too few views show one whole; None otherwise.
    """

    num_views: int
    num_cut: int | None = None


def fill_object_depth(
    config: TrainConfig,
    capture: Capture,
    views: Views,
    alignments: Float[Tensor, "T 2"],
    error: float,
) -> ObjectDepth:
    """Gives views the depth of objects that keep their size, where ``loss.object_depth`` asks for it.

    Captures without masks get none. Where the depth of what moves is known but neither metric nor certain, it is
    averaged with that by size.

    Args:
        config: The config.
        capture: The capture, with masks and static points.
        views: Its training views; the depth of dynamic pixels is changed.
        alignments: [T, 2] scale and offset of each view's inverse depth; set to 1 and 0 for views that had none.
        error: Typical relative error of the depth at the sparse points, aligned by a scale and an offset alone.
    """
    if not (config.loss.object_depth and config.depth and capture.assumption == "masks"):
        return ObjectDepth(0)
    if not is_depth_known(views, alignments):
        return _set_depths(capture, views, alignments)
    if capture.metric_depth or error <= MIN_ERROR:
        return ObjectDepth(0)
    weight = 1.0 / (1.0 + (error / SIZE_ERROR) ** 2)
    return ObjectDepth(average_depths(capture, find_all_objects(views), views, alignments, weight))


def _set_depths(capture: Capture, views: Views, alignments: Float[Tensor, "T 2"]) -> ObjectDepth:
    """Gives objects their depth by size; the arguments are those of ``fill_object_depth``."""
    objects, count = find_all_objects(views), 0
    if (num_cut := num_cut_off(objects)) is not None:
        return ObjectDepth(0, num_cut)
    for index, depth in depth_by_size(capture, views, objects).items():
        if not views.glances[index].has_depth:
            alignments[index] = alignments.new_tensor([1.0, 0.0])
        if bool(alignments[index].isfinite().all()):
            views.set_object_depth(index, alignments[index], depth)
            count += 1
    return ObjectDepth(count)
