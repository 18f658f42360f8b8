"""Depth of dynamic objects from their size.

One camera does not determine how far away something is that moves: twice as large, twice as far away and twice as fast
looks the same. But the distance of an object that keeps its size is inversely proportional to the size at which it is
seen, and the factor is bounded, because the object hides the static surfaces around it. Most objects stand on something
or come close to it at least once, so the largest factor that the bound allows is a good one.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import cache, partial

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture

from .dynamic_points import is_depth_known
from .objects import MovingObject, find_objects, scaled_size
from .point_cloud import front_of_ball
from .views import Views

MIN_FRAMES = 12
"""Minimum number of frames that show an object whole."""

AROUND = 0.015
"""Width of the rim around an object where static points bound its depth, as a fraction of the image's longer side."""

MIN_POINTS = 3
"""Minimum number of points in that rim."""

NEAREST, TIGHTEST = 0.02, 0.05
"""Quantile of these points' depths that is the bound in a frame; quantile of the frames' bounds that is the bound of
the factor. Both tolerate outliers."""

MAX_POINTS = 10_000
"""Maximum number of static points that are projected into each frame."""

Points = tuple[Int[Tensor, " P"], Int[Tensor, " P"], Float[Tensor, " P"]]
"""Rows, columns and depths [scene units] of points."""


def fill_object_depth(config: TrainConfig, capture: Capture, views: Views, alignments: Float[Tensor, "T 2"]) -> int:
    """Gives views the depth of objects that keep their size, where ``loss.object_depth`` asks for it.

    Captures with the depth of what moves keep it, and those without masks get none.

    Args:
        config: The config.
        capture: The capture, with masks and static points.
        views: Its training views; dynamic pixels of unknown depth are changed.
        alignments: [T, 2] scale and offset of each view's inverse depth; set to 1 and 0 for views that had none.

    Returns:
        The number of views that have such depth now.
    """
    is_wanted = config.loss.object_depth and config.depth and capture.assumption == "masks"
    if not is_wanted or is_depth_known(views, alignments):
        return 0
    count = 0
    for index, depth in object_depth(capture).items():
        if capture.frame(capture.train[index]).inverse_depth is None:
            alignments[index] = alignments.new_tensor([1.0, 0.0])
        if bool(alignments[index].isfinite().all()):
            views.set_object_depth(index, alignments[index], depth)
            count += 1
    return count


def object_depth(capture: Capture) -> dict[int, Float[Tensor, "h w"]]:
    """Depth of the objects in a capture's training frames that keep their size.

    Args:
        capture: The capture, with masks and static points.

    Returns:
        By index of the frame, [h, w] depth in its scaled mask [scene units], that of round objects, NaN elsewhere.
    """
    order = sorted(range(len(capture.train)), key=lambda k: capture.cameras[capture.train[k]].time)
    points_of = cache(partial(_static_points, capture))
    depths: dict[int, Tensor] = {}
    for frames in (order, order[::-1]):  # by time first; backward, what parts later can be told apart before
        for item in find_objects(capture, frames):
            for index, depth in _depths(item, capture, points_of).items():
                size = scaled_size(capture.cameras[capture.train[index]])
                values = depths.setdefault(index, torch.full(size[::-1], torch.nan)).view(-1)
                pixels = torch.from_numpy(item.pixels[index]).long()
                values[pixels] = torch.where(values[pixels].isnan(), depth, values[pixels])
    return depths


def _static_points(capture: Capture, index: int) -> Points:
    """Rows and columns in the scaled mask, and depths, of the static points that a training frame shows."""
    frame = capture.frame(capture.train[index])
    assert frame.static_mask is not None
    row, column, depth, inside = frame.camera.project(capture.points[:: -(-len(capture.points) // MAX_POINTS) or 1])
    shown = inside & frame.static_mask[row, column]
    width, height = scaled_size(frame.camera)
    row, column = row[shown] * height // frame.camera.height, column[shown] * width // frame.camera.width
    return row.int(), column.int(), depth[shown]


def _depths(item: MovingObject, capture: Capture, points_of: Callable[[int], Points]) -> dict[int, Float[Tensor, " P"]]:
    """Depth of an object's pixels in each frame that shows it whole or beside another one; none if it cannot be told.

    The measure of size is the one by which the object moves most evenly: the diameter of a ring stays the same while
    it tumbles, the area of a body while it deforms.
    """
    if item.is_mixture or len(item.whole) < MIN_FRAMES:
        return {}
    views = {index: _ObjectView(pixels, capture.cameras[capture.train[index]]) for index, pixels in item.pixels.items()}
    bounds = np.array([views[index].bound(points_of(index)) for index in item.whole])
    if not np.isfinite(bounds).any():
        return {}
    choices = []
    for measure in (_ObjectView.diameter, _ObjectView.area):
        sizes = {index: measure(view) for index, view in views.items() if index in item.whole or not view.is_cut}
        factor = float(np.nanquantile(bounds * [sizes[index] for index in item.whole], TIGHTEST))
        found = {index: factor / size for index, size in sizes.items()}
        path = np.stack([views[index].position(found[index]) for index in item.whole])
        choices.append((float(np.linalg.norm(np.diff(path, 2, axis=0), axis=1).sum()), found))
    return {
        index: views[index].surface(depth) for index, depth in min(choices, key=lambda choice: choice[0])[1].items()
    }


class _ObjectView:
    """An object as one frame sees it.

    Args:
        pixels: Flat indices of its pixels in the scaled mask.
        camera: The camera of the frame.

    Attributes:
        is_cut: Whether it touches the image border.
    """

    def __init__(self, pixels: Int[np.ndarray, " P"], camera: Camera) -> None:
        self._camera = camera.resized(*scaled_size(camera))
        width, height = self._camera.size
        rows, columns = np.divmod(pixels, width)
        self._rows, self._columns = torch.from_numpy(rows).long(), torch.from_numpy(columns).long()
        self.is_cut = bool(((rows == 0) | (rows == height - 1) | (columns == 0) | (columns == width - 1)).any())
        viewed = dataclasses.replace(self._camera, viewmat=torch.eye(4))
        self._slopes = viewed.unproject(self._rows, self._columns, torch.ones(len(pixels)))[:, :2].contiguous().numpy()

    def diameter(self) -> float:
        """Largest distance of two of its pixels at depth 1."""
        hull = cv2.convexHull(self._slopes)[:, 0]
        return float(np.linalg.norm(hull[:, None] - hull, axis=-1).max())

    def area(self) -> float:
        """Square root of its area at depth 1."""
        return math.sqrt(len(self._rows) / float(self._camera.K[0, 0] * self._camera.K[1, 1]))

    def position(self, depth: float) -> Float[np.ndarray, "3"]:
        """Where its centre is at a depth, in scene units."""
        points = self._camera.unproject(self._rows, self._columns, torch.full(self._rows.shape, depth))
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
