"""The median depth at which the cameras of a capture see its scene: the unit of what must mean the same on screen.

Moving by a fraction x of its depth moves a point by x focal lengths in the image, whatever the units of the capture and
however little its cameras move.
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera

from .sampling import evenly_spaced_indices

MAX_CAMERAS, MAX_POINTS = 64, 20_000
"""Maximum number of cameras and of points that are looked at, evenly spaced."""

MIN_SEEN = 10
"""Mean number of points in a camera's image below which their depths say nothing."""

MIN_CONVERGENCE = 0.02
"""Minimum root mean square of the sines of the angles between the optical axes and their common direction: below about
one degree, errors of the poses decide where they meet."""

MIN_SEEING = 0.75
"""Minimum fraction of the cameras that must see the point to which their optical axes converge."""

UNKNOWN_DEPTH = 1.0
"""Median depth where nothing tells it [scene units]: training starts from random points in [-1, 1] then."""


def median_depth(
    cameras: Sequence[Camera], points: Float[Tensor, "P 3"], inverse_depths: Iterable[Float[Tensor, "H W"]]
) -> float:
    """Median depth along the optical axes at which cameras see a scene [scene units], positive and finite.

    By the first that is known: the points that the cameras see; depth images; the point to which the optical axes
    converge; ``UNKNOWN_DEPTH``.

    Args:
        cameras: At least one, on the CPU.
        points: [P, 3] sparse points, P may be 0; those that are not finite count as not seen.
        inverse_depths: Some images of inverse depth in scene units, NaN or 0 where unknown; only read if needed.
    """
    cameras = [cameras[k] for k in evenly_spaced_indices(len(cameras), MAX_CAMERAS)]
    points = points[evenly_spaced_indices(len(points), MAX_POINTS)]
    seen = torch.cat([_depths(camera, points) for camera in cameras])
    if len(seen) < MIN_SEEN * len(cameras):
        images = [image[image.isfinite() & (image > 0)].reciprocal() for image in inverse_depths]
        seen = torch.cat([*images, seen.new_empty(0)])
        seen = seen[seen.isfinite()]
    if not len(seen):
        seen = _depths_of_convergence(cameras)
    return float(seen.median()) if len(seen) else UNKNOWN_DEPTH


def _depths(camera: Camera, points: Float[Tensor, "P 3"]) -> Float[Tensor, " S"]:
    """Depths of the points that a camera sees."""
    _, _, depth, inside = camera.project(points)
    return depth[inside]


def _depths_of_convergence(cameras: Sequence[Camera]) -> Float[Tensor, " S"]:
    """Depth in each camera of the point nearest to all optical axes; none where they do not converge in front of it.

    For axes with unit directions d through positions p, the sum of squared distances is smallest where
    Σ (I − d dᵀ) x = Σ (I − d dᵀ) p. The smallest eigenvalue of the mean of I − d dᵀ is the mean squared sine of the
    angles between the axes and their common direction.
    """
    directions = torch.stack([camera.viewmat[2, :3] for camera in cameras]).double()
    positions = torch.stack([camera.position for camera in cameras]).double()
    across = torch.eye(3, dtype=torch.float64) - directions[:, :, None] * directions[:, None, :]
    matrix = across.mean(0)
    if not torch.linalg.eigvalsh(matrix)[0] >= MIN_CONVERGENCE**2:
        return torch.zeros(0, dtype=torch.float32)
    point = torch.linalg.solve(matrix, (across @ positions[:, :, None]).mean(0)).float().T
    depths = torch.cat([_depths(camera, point) for camera in cameras])
    return depths if len(depths) >= MIN_SEEING * len(cameras) else depths[:0]
