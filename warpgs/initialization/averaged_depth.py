"""The known depth of dynamic objects, averaged with their depth by size."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.depth_alignment import metric_depth
from warpgs.data.dynamic_regions import MIN_FRAMES, scaled_size
from warpgs.data.masks import nearest_pixels
from warpgs.views.views import View, Views

from .depth_by_size import paint
from .objects import MovingObject
from .packed import packed_images
from .point_cloud import filled
from .seen_objects import SeenObject, Sizes, see_objects

RIM = 0.008
"""Width of the rim of dynamic objects in which a network's depth is replaced, as a fraction of the image's longer side:
it changes smoothly to that of what is behind them."""


def average_depths(
    capture: Capture, objects: Sequence[MovingObject], views: Views, alignments: Float[Tensor, "T 2"], weight: float
) -> int:
    """Moves each object to the weighted geometric mean of its depth and that by its size, in all frames that show it.

    Both have errors of their own: a depth network misplaces objects as a whole, by amounts that change with time, and
    the size may change a little. The factor of depth by size is between the median of depth times size and the bound.
    Before that, the rims of objects get the depth that is known further inside.

    Args:
        capture: The capture, with masks and static points.
        objects: All of its objects.
        views: Its training views, changed.
        alignments: [T, 2] scale and offset of each view's inverse depth.
        weight: Weight of the views' depth, in [0, 1].

    Returns:
        The number of views in which objects were moved.
    """
    aligned = alignments.isfinite().all(1).tolist()
    cameras = [capture.cameras[name] for name in capture.train]

    whole = [item for item in objects if not item.is_mostly_cut]

    def known_depths(index: int) -> dict[MovingObject, float]:
        if aligned[index]:
            views.change_depth(index, without_rims)
        depth = _scaled_depth(views[index], alignments[index], cameras[index]).flat
        return {item: _mean_known(depth[item.pixels[index]]) for item in whole if index in item.pixels}

    depths, images = list(views.in_threads(known_depths, range(len(views)))), packed_images()
    for item, sizes in see_objects(capture, views, whole, SeenObject.sizes):
        known = {index: depths[index][item] for index in item.pixels}
        times = {index: cameras[index].time for index in known}
        corrections = _corrections(sizes, known, times, 1.0 - weight)
        paint(images, views, item, {k: filled(len(item.pixels[k]), 1.0 / value) for k, value in corrections.items()})
    chosen = [index for index in images if aligned[index]]
    return len(list(views.in_threads(lambda k: _multiply(views, k, alignments[k], images[k]), chosen)))


def _multiply(views: Views, index: int, alignment: Float[Tensor, "2"], factor: Float[Tensor, "h w"]) -> None:
    """Multiplies a view's aligned inverse depth by a factor at dynamic pixels, where it is known."""
    static = views[index].static_mask.cpu()
    resized = cv2.resize(factor.nan_to_num(1.0).numpy(), static.shape[::-1], interpolation=cv2.INTER_NEAREST)
    views.set_depth_factor(index, alignment, torch.where(static, 1.0, torch.from_numpy(resized)))


def without_rims(inverse_depth: Float[Tensor, "H W"], static_mask: Bool[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Replaces the depth in the rims of dynamic objects by that of the nearest pixel inside of the same object.

    A rim is ``RIM`` wide. What is more than two rims away from the inside of its object stays, such as thin parts.

    Args:
        inverse_depth: [H, W] inverse depth up to a scale and an offset, NaN where unknown; on the CPU.
        static_mask: [H, W] true where the scene is static.

    Returns:
        [H, W] inverse depth, changed at dynamic pixels only.
    """
    width, is_dynamic = RIM * max(static_mask.shape), (~static_mask).numpy().astype(np.uint8)
    is_rim = (is_dynamic > 0) & (cv2.distanceTransform(is_dynamic, cv2.DIST_L2, 5) <= width)
    inside = (is_dynamic > 0) & ~is_rim & inverse_depth.isfinite().numpy()
    if not inside.any():
        return inverse_depth
    (nearest, distance), (_, item) = nearest_pixels(inside), cv2.connectedComponents(is_dynamic)
    is_rim &= (distance <= 2.0 * width) & (item.ravel()[nearest] == item)
    return torch.where(torch.from_numpy(is_rim), inverse_depth.flatten()[torch.from_numpy(nearest)], inverse_depth)


def _scaled_depth(view: View, alignment: Float[Tensor, "2"], camera: Camera) -> Float[np.ndarray, "h w"]:
    """A view's aligned depth at the pixels of its scaled mask."""
    depth = metric_depth(view.inverse_depth, alignment).cpu().numpy()
    return cv2.resize(depth, scaled_size(camera.size), interpolation=cv2.INTER_NEAREST)


def _mean_known(depths: Float[np.ndarray, " P"]) -> float:
    """The mean of the depths that are known; NaN if none is."""
    known = depths[np.isfinite(depths)]
    return float(known.mean()) if len(known) else math.nan


def _corrections(
    sizes: list[Sizes], known: dict[int, float], times: dict[int, float], weight: float
) -> dict[int, float]:
    """Factors of the known depth of an object in each frame that bring it to a weighted mean with depth by size.

    The measure of size is the one by which depth times size varies least. Frames without a size or a depth are
    corrected as those around them.

    Args:
        sizes: The object's sizes by each measure.
        known: Its known depth by index of the frame; NaN where unknown.
        times: Times of the same frames.
        weight: Weight of the depth by size.
    """
    choices = []
    for sizes_by, bound in sizes:
        frames = sorted((index for index in sizes_by if math.isfinite(known[index])), key=times.__getitem__)
        if len(frames) < MIN_FRAMES:
            continue
        products = np.log([known[index] * sizes_by[index] for index in frames])
        median = float(np.median(products))
        factor = median if math.isnan(bound) else 0.5 * (median + math.log(bound))
        choices.append((float(products.std()), [times[index] for index in frames], weight * (factor - products)))
    if not choices:
        return {}
    _, at, logs = min(choices, key=lambda choice: choice[0])
    return {index: math.exp(np.interp(time, at, logs)) for index, time in times.items()}
