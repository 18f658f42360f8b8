"""Depth of dynamic objects by their size, in each frame that shows them."""

import math
from collections.abc import Mapping, MutableMapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.data.capture import Capture
from warpgs.data.dynamic_regions import MIN_FRAMES, scaled_size
from warpgs.views.views import Views

from .objects import MovingObject
from .packed import packed_images
from .point_cloud import filled
from .seen_objects import SeenObject, see_objects

SMOOTHING = 0.05
"""Standard deviation of the time, of all in [0, 1], over which the depth around an object is smoothed."""


def depth_by_size(
    capture: Capture, views: Views, objects: Sequence[MovingObject]
) -> Mapping[int, Float[Tensor, "h w"]]:
    """Depth of the objects in a capture's training frames, if it has some that keep their size.

    Args:
        capture: The capture, with static points.
        views: Its training views.
        objects: All of its objects.

    Returns:
        By index of the frame, [h, w] depth in its scaled mask [scene units], NaN elsewhere: that of round objects, or,
        of objects that are hardly ever whole, of flat ones as far away as the static points around them.
    """
    images = packed_images()
    whole, cut = ([item for item in objects if item.is_mostly_cut == is_cut] for is_cut in (False, True))
    for item, depths in see_objects(capture, views, whole, _depths):
        paint(images, views, item, depths)
    if images:  # without any depth, dynamic Gaussians start in front of the points around them
        for item, depths in see_objects(capture, views, cut, _depths_around):
            paint(images, views, item, depths)
    return images


def paint(
    images: MutableMapping[int, Float[Tensor, "h w"]],
    views: Views,
    item: MovingObject,
    values: Mapping[int, Float[Tensor, " P"]],
) -> None:
    """Writes values of an object's pixels into images of the scaled masks, where these have none yet.

    Args:
        images: [h, w] values by index of the frame, NaN where there are none; images that are missing are added.
        views: The training views.
        item: The object.
        values: Values of its pixels by index of the frame.
    """
    for index, found in values.items():
        image = images.get(index)
        if image is None:
            image = torch.full(scaled_size(views.camera(index).size)[::-1], torch.nan, dtype=torch.float32)
        flat, pixels = image.view(-1), torch.from_numpy(item.pixels[index]).long()
        flat[pixels] = torch.where(flat[pixels].isnan(), found, flat[pixels])
        images[index] = image


def _depths(seen: SeenObject) -> dict[int, Float[Tensor, " P"]]:
    """Depth of an object's pixels in each frame that shows it whole or near another one; none if it cannot be told.

    The measure of size is the one by which the object moves most evenly: the diameter of a ring stays the same while
    it tumbles, the area of a body while it deforms.
    """
    measured = seen.sizes()
    if any(math.isnan(factor) for _, factor in measured):
        return {}
    choices = [{index: factor / size for index, size in sizes.items()} for sizes, factor in measured]
    paths = np.stack([seen.positions(index, [found[index] for found in choices]) for index in seen.item.whole], 1)
    bends = [float(np.linalg.norm(np.diff(path, 2, axis=0), axis=1).sum()) for path in paths]
    _, depths = min(zip(bends, choices, strict=True), key=lambda choice: choice[0])
    return {index: seen.view(index).surface(depth) for index, depth in depths.items()}


def _depths_around(seen: SeenObject) -> dict[int, Float[Tensor, " P"]]:
    """Depth of the static points around an object, smoothed over time, at its pixels by frame; none if unknown."""
    bounds = {index: seen.view(index).bound(seen.points_of(index)) for index in seen.item.pixels}
    known = [index for index, bound in bounds.items() if math.isfinite(bound)]
    if len(known) < MIN_FRAMES:
        return {}
    times = np.array([seen.camera_of(index).time for index in known])
    logs = np.log([bounds[index] for index in known])
    found = {}
    for index, pixels in seen.item.pixels.items():
        weights = np.exp(-0.5 * ((times - seen.camera_of(index).time) / SMOOTHING) ** 2)
        found[index] = filled(len(pixels), math.exp(np.average(logs, weights=weights)))
    return found
