"""Points of a capture whose camera stays at one place: on a sphere around it, or as far away as a network says."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from warpgs.data.sampling import evenly_spaced_indices

from .recovered import Cameras

MAX_FRAMES, GRID = 40, 24
"""Number of frames that points are taken from, and of points across each of them."""

MAX_DISTANCE = 5.0
"""Distance of the farthest points, over the median: inverse depth of a network reaches 0."""


def points_around(
    cameras: Cameras,
    dynamic: Sequence[Bool[np.ndarray, "H W"]],
    planes: Sequence[Float[np.ndarray, "h w"]] | None = None,
) -> Float[np.ndarray, "P 3"]:
    """[P, 3] points in static regions, evenly spread over the frames.

    Args:
        cameras: Cameras at the origin.
        dynamic: [H, W] dynamic mask of each.
        planes: [h, w] inverse depth of each frame, in any size; each frame's median is at distance 1, and frames
            without any give no points. If None, all points are at distance 1: nothing tells another one.
    """
    lens, points = cameras.lens, []
    across, down = GRID, max(2, round(GRID * lens.height / lens.width))
    u, v = np.meshgrid((np.arange(across) + 0.5) / across, (np.arange(down) + 0.5) / down)
    x, y = lens.unproject(u * lens.width, v * lens.height)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    for k in evenly_spaced_indices(len(cameras.names), MAX_FRAMES):
        static = ~_at(dynamic[k], u, v)
        if planes is None:
            placed = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        else:
            known = planes[k][np.isfinite(planes[k])]
            if not len(known) or not np.median(known) > 0.0:
                continue
            relative = _at(planes[k], u, v) / np.median(known)
            placed = rays / np.maximum(relative, 1.0 / MAX_DISTANCE)[..., None]
            static &= np.isfinite(relative)
        points.append(placed[static] @ cameras.poses[k, :, :3])
    return np.concatenate([np.zeros((0, 3)), *points])


def _at(plane: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The values of a plane at positions relative to its size."""
    return plane[(v * plane.shape[0]).astype(int), (u * plane.shape[1]).astype(int)]
