"""Depth of dynamic objects from their size.

One camera does not determine how far away something is that moves: twice as large, twice as far away and twice as fast
looks the same. But the distance of an object that keeps its size is inversely proportional to the size at which it is
seen, and the factor is bounded, because the object hides the static surfaces around it. Most objects stand on something
or come close to it at least once, so the largest factor that the bound allows is a good one. Objects that the image
border cuts off in most frames have no size; beside others that have one, they get the depth of what is around them.

The depth of a network has the right order of magnitude, and misplaces each object as a whole by an amount that changes
with time. Both depths are averaged then.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from operator import attrgetter
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.data.depth_alignment import metric_depth, typical_error
from warpgs.data.dynamic_regions import MIN_FRAMES, scaled_size
from warpgs.data.masks import nearest_pixels
from warpgs.views.views import View, Views

from .dynamic_points import is_depth_known
from .objects import MovingObject, find_all_objects, num_cut_off
from .point_cloud import filled, front_of_ball

AROUND = 0.015
"""Width of the rim around an object where static points bound its depth, as a fraction of the image's longer side."""

MIN_POINTS = 3
"""Minimum number of points in that rim."""

NEAREST, TIGHTEST = 0.02, 0.05
"""Quantile of these points' depths that is the bound in a frame; quantile of the frames' bounds that is the bound of
the factor. Both tolerate outliers."""

MAX_POINTS = 10_000
"""Maximum number of static points that are projected into each frame."""

SMOOTHING = 0.05
"""Standard deviation of the time, of all in [0, 1], over which the depth around an object is smoothed."""

SIZE_ERROR = 0.02
"""Relative error of a capture's depth at the sparse points at which it and depth by size have the same weight; chosen
on two captures (docs/design/object-depth.md)."""

RIM = 0.008
"""Width of the rim of dynamic objects in which a network's depth is replaced, as a fraction of the image's longer side:
it changes smoothly to that of what is behind them."""

MIN_ERROR = 0.016
"""Relative error of a capture's depth at the sparse points up to which it stays as it is."""

Points = tuple[Int[Tensor, " P"], Int[Tensor, " P"], Float[Tensor, " P"]]
"""Rows, columns and depths [scene units] of points."""


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
    errors: Float[Tensor, " T"],
) -> ObjectDepth:
    """Gives views the depth of objects that keep their size, where ``loss.object_depth`` asks for it.

    Captures without masks get none. Where the depth of what moves is known but neither metric nor certain, it is
    averaged with that by size.

    Args:
        config: The config.
        capture: The capture, with masks and static points.
        views: Its training views; the depth of dynamic pixels is changed.
        alignments: [T, 2] scale and offset of each view's inverse depth; set to 1 and 0 for views that had none.
        errors: [T] relative error of each view's depth at the sparse points, aligned by a scale and an offset alone;
            infinite if not aligned.
    """
    if not (config.loss.object_depth and config.depth and capture.assumption == "masks"):
        return ObjectDepth(0)
    if not is_depth_known(views, alignments):
        return _set_depths(capture, views, alignments)
    error = float(typical_error(errors))
    if capture.metric_depth or error <= MIN_ERROR:
        return ObjectDepth(0)
    return ObjectDepth(_average_depths(capture, views, alignments, 1.0 / (1.0 + (error / SIZE_ERROR) ** 2)))


def _set_depths(capture: Capture, views: Views, alignments: Float[Tensor, "T 2"]) -> ObjectDepth:
    """Gives objects their depth by size; the arguments are those of ``fill_object_depth``."""
    objects, count = find_all_objects(capture), 0
    if (num_cut := num_cut_off(objects)) is not None:
        return ObjectDepth(0, num_cut)
    for index, depth in object_depth(capture, objects).items():
        if capture.frame(capture.train[index]).inverse_depth is None:
            alignments[index] = alignments.new_tensor([1.0, 0.0])
        if bool(alignments[index].isfinite().all()):
            views.set_object_depth(index, alignments[index], depth)
            count += 1
    return ObjectDepth(count)


def _average_depths(capture: Capture, views: Views, alignments: Float[Tensor, "T 2"], weight: float) -> int:
    """Moves each object to the weighted geometric mean of its depth and that by its size, in all frames that show it.

    Both have errors of their own: a depth network misplaces objects as a whole, by amounts that change with time, and
    the size may change a little. The factor of depth by size is between the median of depth times size and the bound.
    Before that, the rims of objects get the depth that is known further inside.

    Args:
        capture: The capture, with masks and static points.
        views: Its training views, changed.
        alignments: [T, 2] scale and offset of each view's inverse depth.
        weight: Weight of the views' depth; 1 / (1 + (error / SIZE_ERROR)²) if its relative error is known.

    Returns:
        The number of views in which objects were moved.
    """
    aligned = set(alignments.isfinite().all(1).nonzero()[:, 0].tolist())
    for index in aligned:
        views.change_depth(index, without_rims)
    cameras = [capture.cameras[name] for name in capture.train]
    depths = [_scaled_depth(*of) for of in zip(views, alignments, cameras, strict=True)]

    def factors(
        item: MovingObject, seen: dict[int, _ObjectView], points_of: Callable[[int], Points]
    ) -> dict[int, Float[Tensor, " P"]]:
        known = {index: _mean_known(depths[index].flat[pixels]) for index, pixels in item.pixels.items()}
        times = {index: cameras[index].time for index in known}
        corrections = _corrections(_sizes(item, seen, points_of), known, times, 1.0 - weight)
        return {k: filled(len(item.pixels[k]), 1.0 / value) for k, value in corrections.items()}

    found = {
        index: factor
        for index, factor in _by_object(capture, find_all_objects(capture), factors).items()
        if index in aligned
    }
    for index, factor in found.items():
        static = views[index].static_mask.cpu()
        resized = cv2.resize(factor.nan_to_num(1.0).numpy(), static.shape[::-1], interpolation=cv2.INTER_NEAREST)
        views.set_depth_factor(index, alignments[index], torch.where(static, 1.0, torch.from_numpy(resized)))
    return len(found)


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
    return cv2.resize(depth, scaled_size(camera), interpolation=cv2.INTER_NEAREST)


def _mean_known(depths: Float[np.ndarray, " P"]) -> float:
    """The mean of the depths that are known; NaN if none is."""
    known = depths[np.isfinite(depths)]
    return float(known.mean()) if len(known) else math.nan


def _corrections(
    sizes: list["_Sizes"], known: dict[int, float], times: dict[int, float], weight: float
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


def object_depth(capture: Capture, objects: Sequence[MovingObject]) -> dict[int, Float[Tensor, "h w"]]:
    """Depth of the objects in a capture's training frames, if it has some that keep their size.

    Args:
        capture: The capture, with masks and static points.
        objects: All of its objects.

    Returns:
        By index of the frame, [h, w] depth in its scaled mask [scene units], NaN elsewhere: that of round objects, or,
        of objects that are hardly ever whole, of flat ones as far away as the static points around them.
    """
    return _by_object(capture, objects, _depths, _depths_around)


def _by_object(
    capture: Capture,
    objects: Sequence[MovingObject],
    values_of: Callable[..., dict[int, Float[Tensor, " P"]]],
    values_of_cut: Callable[..., dict[int, Float[Tensor, " P"]]] = lambda *_: {},
) -> dict[int, Float[Tensor, "h w"]]:
    """By index of the frame, [h, w] values of objects' pixels in its scaled mask, NaN elsewhere.

    Objects that cannot be told apart have no values.

    Args:
        capture: The capture, with masks and static points.
        objects: All of its objects.
        values_of: Given an object, how each frame sees it, and the static points that a frame shows: the values of its
            pixels by index of the frame.
        values_of_cut: The same for objects that too few frames show whole. It is asked last, if others have values, and
            fills pixels without one; by default it has none.
    """
    points_of = cache(partial(_static_points, capture))
    images: dict[int, Tensor] = {}
    for item in sorted((item for item in objects if not item.is_mixture), key=attrgetter("is_mostly_cut")):
        if item.is_mostly_cut and not images:
            break  # without any depth, dynamic Gaussians start in front of the points around them
        seen = {k: _ObjectView(pixels, capture.cameras[capture.train[k]]) for k, pixels in item.pixels.items()}
        choose = values_of_cut if item.is_mostly_cut else values_of
        for index, found in choose(item, seen, points_of).items():
            size = scaled_size(capture.cameras[capture.train[index]])
            values = images.setdefault(index, torch.full(size[::-1], torch.nan, dtype=torch.float32)).view(-1)
            pixels = torch.from_numpy(item.pixels[index]).long()
            values[pixels] = torch.where(values[pixels].isnan(), found, values[pixels])
    return images


def _static_points(capture: Capture, index: int) -> Points:
    """Rows and columns in the scaled mask, and depths, of the static points that a training frame shows."""
    frame = capture.frame(capture.train[index])
    assert frame.static_mask is not None
    row, column, depth, inside = frame.camera.project(capture.points[:: -(-len(capture.points) // MAX_POINTS) or 1])
    shown = inside & frame.static_mask[row, column]
    width, height = scaled_size(frame.camera)
    row, column = row[shown] * height // frame.camera.height, column[shown] * width // frame.camera.width
    return row.int(), column.int(), depth[shown]


def _depths(
    item: MovingObject, seen: dict[int, "_ObjectView"], points_of: Callable[[int], Points]
) -> dict[int, Float[Tensor, " P"]]:
    """Depth of an object's pixels in each frame that shows it whole or beside another one; none if it cannot be told.

    The measure of size is the one by which the object moves most evenly: the diameter of a ring stays the same while
    it tumbles, the area of a body while it deforms.
    """
    choices = []
    for sizes, factor in _sizes(item, seen, points_of):
        if math.isnan(factor):
            return {}
        found = {index: factor / size for index, size in sizes.items()}
        path = np.stack([seen[index].position(found[index]) for index in item.whole])
        choices.append((float(np.linalg.norm(np.diff(path, 2, axis=0), axis=1).sum()), found))
    _, depths = min(choices, key=lambda choice: choice[0])
    return {index: seen[index].surface(depth) for index, depth in depths.items()}


def _depths_around(
    item: MovingObject, seen: dict[int, "_ObjectView"], points_of: Callable[[int], Points]
) -> dict[int, Float[Tensor, " P"]]:
    """Depth of the static points around an object, smoothed over time, at its pixels by frame; none if unknown."""
    bounds = {index: view.bound(points_of(index)) for index, view in seen.items()}
    known = [index for index, bound in bounds.items() if math.isfinite(bound)]
    if len(known) < MIN_FRAMES:
        return {}
    times, logs = np.array([seen[index].time for index in known]), np.log([bounds[index] for index in known])
    found = {}
    for index, view in seen.items():
        weights = np.exp(-0.5 * ((times - view.time) / SMOOTHING) ** 2)
        found[index] = filled(len(item.pixels[index]), math.exp(np.average(logs, weights=weights)))
    return found


class _Sizes(NamedTuple):
    """An object's size by one measure.

    Attributes:
        sizes: By index of the frame, in those that show it whole or beside another one [at depth 1].
        bound: Largest factor by which depth may be divided by size, by the static points around it; NaN if unknown.
    """

    sizes: dict[int, float]
    bound: float


def _sizes(item: MovingObject, seen: dict[int, "_ObjectView"], points_of: Callable[[int], Points]) -> list[_Sizes]:
    """An object's size by each measure."""
    bounds = np.array([seen[index].bound(points_of(index)) for index in item.whole])
    known = np.isfinite(bounds).any()
    found = []
    for measure in (_ObjectView.diameter, _ObjectView.area):
        sizes = {index: measure(view) for index, view in seen.items() if index not in item.cut}
        factors = bounds * [sizes[index] for index in item.whole]
        found.append(_Sizes(sizes, float(np.nanquantile(factors, TIGHTEST)) if known else math.nan))
    return found


class _ObjectView:
    """An object as one frame sees it.

    Args:
        pixels: Flat indices of its pixels in the scaled mask.
        camera: The camera of the frame.

    Attributes:
        time: Time of the frame in [0, 1].
    """

    def __init__(self, pixels: Int[np.ndarray, " P"], camera: Camera) -> None:
        self._camera = camera.resized(*scaled_size(camera))
        self.time = camera.time
        rows, columns = np.divmod(pixels, self._camera.width)
        self._rows, self._columns = torch.from_numpy(rows).long(), torch.from_numpy(columns).long()
        viewed = dataclasses.replace(self._camera, viewmat=torch.eye(4, dtype=torch.float32))
        self._slopes = viewed.unproject(self._rows, self._columns, filled(len(pixels), 1.0))[:, :2].contiguous().numpy()

    def diameter(self) -> float:
        """Largest distance of two of its pixels at depth 1."""
        hull = cv2.convexHull(self._slopes)[:, 0]
        return float(np.linalg.norm(hull[:, None] - hull, axis=-1).max())

    def area(self) -> float:
        """Square root of its area at depth 1."""
        return math.sqrt(len(self._rows) / float(self._camera.K[0, 0] * self._camera.K[1, 1]))

    def position(self, depth: float) -> Float[np.ndarray, "3"]:
        """Where its centre is at a depth, in scene units."""
        points = self._camera.unproject(self._rows, self._columns, filled(len(self._rows), depth))
        return points.mean(0).double().numpy()

    def surface(self, depth: float) -> Float[Tensor, " P"]:
        """Depth of its pixels if it is round, with that mean."""
        points = depth * self._slopes
        nearer = front_of_ball(points - points.mean(0))
        return torch.from_numpy(depth + nearer.mean() - nearer).float()

    def bound(self, points: Points) -> float:
        """Depth of the static points around it; NaN if there are too few."""
        row, column, depth = points
        width, height = self._camera.size
        region = np.zeros((height, width), np.uint8)
        region[self._rows, self._columns] = 1
        reach = 2 * max(1, round(AROUND * max(width, height))) + 1
        around = torch.from_numpy(cv2.dilate(region, np.ones((reach, reach), np.uint8)) > 0)
        near = depth[around[row, column]]
        return float(near.quantile(NEAREST)) if len(near) >= MIN_POINTS else math.nan
