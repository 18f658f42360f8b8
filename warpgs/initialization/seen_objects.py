"""Dynamic objects as training frames see them: their size, and the static points around them."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, cached_property, partial
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.dynamic_regions import scaled_size
from warpgs.data.read_ahead import ReadAhead
from warpgs.views.views import Views

from .objects import MovingObject
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

Measured = TypeVar("Measured")

Points = tuple[Int[Tensor, " P"], Int[Tensor, " P"], Float[Tensor, " P"]]
"""Rows, columns and depths [scene units] of points."""


def see_objects(
    capture: Capture, views: Views, objects: Sequence[MovingObject], measure: Callable[["SeenObject"], Measured]
) -> Iterator[tuple[MovingObject, Measured]]:
    """Measures objects as a capture's training frames see them, in threads; those that cannot be told apart not.

    Args:
        capture: The capture, with static points.
        views: Its training views.
        objects: The objects.
        measure: Called with each of them, by several threads at once.
    """
    points_of = cache(partial(_static_points, capture, views))
    told_apart = [item for item in objects if not item.is_mixture]

    def measured(k: int) -> Measured:
        return measure(SeenObject(told_apart[k], views.camera, points_of))

    yield from zip(told_apart, ReadAhead(measured).each(range(len(told_apart))), strict=True)


def _static_points(capture: Capture, views: Views, index: int) -> Points:
    """Rows and columns in the scaled mask, and depths, of the static points that a training frame shows."""
    camera = views.camera(index)
    row, column, depth, inside = camera.project(capture.points[:: -(-len(capture.points) // MAX_POINTS) or 1])
    shown = inside & views.glances[index].static_mask[row, column]
    width, height = scaled_size(camera.size)
    row, column = row[shown] * height // camera.height, column[shown] * width // camera.width
    return row.int(), column.int(), depth[shown]


class Sizes(NamedTuple):
    """An object's size by one measure.

    Attributes:
        sizes: By index of the frame, in those that show it whole or next to another one [at depth 1].
        bound: Largest factor by which depth may be divided by size, by the static points around it; NaN if unknown.
    """

    sizes: dict[int, float]
    bound: float


class SeenObject(NamedTuple):
    """An object as training frames see it.

    Attributes:
        item: The object.
        camera_of: Given the index of a frame, its camera.
        points_of: Given the index of a frame, the static points that it shows.
    """

    item: MovingObject
    camera_of: Callable[[int], Camera]
    points_of: Callable[[int], Points]

    def view(self, index: int) -> "ObjectView":
        """How a frame sees it; those of all frames of a long video together would take gigabytes."""
        return ObjectView(self.item.pixels[index], self.camera_of(index))

    def positions(self, index: int, depths: Sequence[float]) -> Float[np.ndarray, "D 3"]:
        """Where its centre is at each of some depths, as a frame sees it, in scene units."""
        view = self.view(index)
        return np.stack([view.position(depth) for depth in depths])

    def sizes(self) -> list[Sizes]:
        """Its size by each measure."""
        whole, cut = {*self.item.whole}, {*self.item.cut}
        bound_of, measured = dict[int, float](), dict[int, tuple[float, float]]()
        for index in self.item.pixels:
            if index not in cut:
                view = self.view(index)
                measured[index] = view.diameter(), view.area()
                if index in whole:
                    bound_of[index] = view.bound(self.points_of(index))
        bounds = np.array([bound_of[index] for index in self.item.whole])
        known = np.isfinite(bounds).any()
        found = []
        for k in range(2):
            sizes = {index: both[k] for index, both in measured.items()}
            factors = bounds * [sizes[index] for index in self.item.whole]
            found.append(Sizes(sizes, float(np.nanquantile(factors, TIGHTEST)) if known else math.nan))
        return found


class ObjectView:
    """An object as one frame sees it.

    Args:
        pixels: Flat indices of its pixels in the scaled mask.
        camera: The camera of the frame.

    Attributes:
        size: (width, height) of the scaled mask.
    """

    def __init__(self, pixels: Int[np.ndarray, " P"], camera: Camera) -> None:
        self._camera = camera.resized(*scaled_size(camera.size))
        self.size = self._camera.size
        rows, columns = np.divmod(pixels, self._camera.width)
        self._rows, self._columns = torch.from_numpy(rows).long(), torch.from_numpy(columns).long()

    @cached_property
    def _positions(self) -> Float[Tensor, "P 2"]:
        return torch.stack([self._columns, self._rows], 1) + 0.5

    @cached_property
    def _rays(self) -> Float[np.ndarray, "P 3"]:
        return self._camera.rays(self._positions).nan_to_num().numpy()

    def diameter(self) -> float:
        """Largest distance of two of its pixels at depth 1."""
        hull = self._rays[cv2.convexHull(self._positions.numpy(), returnPoints=False)[:, 0]]
        return float(np.linalg.norm(hull[:, None] - hull, axis=-1).max())

    def area(self) -> float:
        """Square root of its area at depth 1."""
        return math.sqrt(float(self._camera.pixel_areas(self._positions.double()).nansum()))

    def position(self, depth: float) -> Float[np.ndarray, "3"]:
        """Where its centre is at a depth, in scene units."""
        points = self._camera.unproject(self._rows, self._columns, filled(len(self._rows), depth))
        return points.mean(0).double().numpy()

    def surface(self, depth: float) -> Float[Tensor, " P"]:
        """Depth of its pixels if it is round, with that mean."""
        points = depth * self._rays
        nearer = front_of_ball(points - points.mean(0))
        return torch.from_numpy(depth + nearer.mean() - nearer).float()

    def bound(self, points: Points) -> float:
        """Depth of the static points around it; NaN if there are too few."""
        row, column, depth = points
        width, height = self.size
        region = np.zeros((height, width), np.uint8)
        region[self._rows, self._columns] = 1
        reach = 2 * max(1, round(AROUND * max(width, height))) + 1
        around = torch.from_numpy(cv2.dilate(region, np.ones((reach, reach), np.uint8)) > 0)
        near = depth[around[row, column]]
        return float(near.quantile(NEAREST)) if len(near) >= MIN_POINTS else math.nan
