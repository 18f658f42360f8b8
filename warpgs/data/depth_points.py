"""Static points from depth in the units of the cameras, for captures that have no sparse points."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from .lens import Lens

MAX_POINTS = 40_000
"""Maximum number of points."""

TOLERANCE = 0.05
"""Relative difference of the depths of one point in two views that confirm each other."""


class DepthView(NamedTuple):
    """A view with depth.

    Attributes:
        image: [H, W, 3] RGB.
        inverse_depth: [H, W] along the optical axis, in the units of the pose, NaN where unknown.
        static: [H, W] true where static.
        lens: The lens, of images of this size.
        pose: [3, 4] world to camera, OpenCV axes.
    """

    image: UInt8[np.ndarray, "H W 3"]
    inverse_depth: Float[np.ndarray, "H W"]
    static: Bool[np.ndarray, "H W"]
    lens: Lens
    pose: Float[np.ndarray, "3 4"]


def points_of_views(views: Sequence[DepthView]) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Points at random static pixels whose depth the view before or after confirms, and their colours.

    Args:
        views: In the order of time; the points of a single view are not confirmed.

    Returns:
        [P, 3] points in the world and [P, 3] colours; P may be 0.
    """
    generator = np.random.default_rng(0)
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for k, view in enumerate(views):
        rows, columns = np.nonzero(view.static & (view.inverse_depth > 0))
        chosen = generator.permutation(len(rows))[: 2 * MAX_POINTS // len(views)]
        row, column = rows[chosen], columns[chosen]
        found = _unproject(view, row, column)
        others = [views[other] for other in (k - 1, k + 1) if 0 <= other < len(views)]
        confirmed = np.zeros(len(found), bool) if others else np.ones(len(found), bool)
        for other in others:
            confirmed |= _agrees(other, found)
        keep = np.flatnonzero(confirmed)[: MAX_POINTS // len(views)]
        points.append(found[keep])
        colors.append(view.image[row[keep], column[keep]])
    return np.concatenate(points), np.concatenate(colors)


def _unproject(view: DepthView, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    rays = view.lens.rays(column + 0.5, row + 0.5)
    in_camera = rays / (view.lens.file_depths(rays) * view.inverse_depth[row, column])[:, None]
    return (in_camera - view.pose[:, 3]) @ view.pose[:, :3]


def _agrees(view: DepthView, points: np.ndarray) -> np.ndarray:
    """Whether the points lie on the surface that a view sees there."""
    in_camera = points @ view.pose[:, :3].T + view.pose[:, 3]
    depth = view.lens.file_depths(in_camera)
    front = depth > 1e-9
    pixels = view.lens.project(np.where(front[:, None], in_camera, (0.0, 0.0, 1.0)))
    height, width = view.inverse_depth.shape
    inside = front & (pixels >= 0).all(1) & (pixels < (width, height)).all(1)
    column, row = np.where(inside[:, None], pixels, 0.0).astype(int).T
    with np.errstate(invalid="ignore"):
        return inside & view.static[row, column] & (np.abs(view.inverse_depth[row, column] * depth - 1.0) < TOLERANCE)
