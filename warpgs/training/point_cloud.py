"""The first Gaussians."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.model.gaussians import MAX_SH_DEGREE, Gaussians

FIRST_OPACITY = 0.1
NEIGHBOURS = 3
BOX_MARGIN = 1.2


def from_points(
    points: Float[Tensor, "N 3"],
    colors: Float[Tensor, "N 3"],
    sh_degree: int = MAX_SH_DEGREE,
    largest: float = math.inf,
) -> Gaussians:
    """Round Gaussians, each as large as the root mean square distance to its three nearest neighbours (3DGS).

    None is larger than ``largest`` [scene units].
    """
    N = points.shape[0]
    if N <= NEIGHBOURS:
        return Gaussians.from_points(points, colors, torch.full((N,), min(0.01, largest)), FIRST_OPACITY, sh_degree)
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=NEIGHBOURS + 1, workers=-1)
    scales = torch.from_numpy(np.sqrt((distances[:, 1:] ** 2).mean(1))).float()
    # Points at one place would get no size at all, a few far ones the size of the scene.
    typical = scales.median().clamp_min(1e-7)
    scales = scales.clamp(1e-3 * typical, 10.0 * typical).clamp_max(largest)
    return Gaussians.from_points(points, colors, scales, FIRST_OPACITY, sh_degree)


def scene_box(points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """(center, half size) of the box that holds all but the outermost 1 % of the points, with a margin.

    Without points, the box from -1 to 1 that captures are normalised to.
    """
    if points.shape[0] < 2:
        return torch.zeros(3), torch.ones(3)
    ordered = points.sort(0).values
    last = points.shape[0] - 1
    low, high = ordered[round(0.005 * last)], ordered[round(0.995 * last)]
    # One length for all axes keeps the frequencies of the encoding alike along them.
    half_size = (0.5 * BOX_MARGIN * (high - low).max()).clamp_min(1e-3)
    return 0.5 * (low + high), half_size.expand(3).contiguous()


def subsample(points: Tensor, most: int, generator: torch.Generator) -> Tensor:
    """Indices of at most ``most`` of the points, chosen at random, in order."""
    if points.shape[0] <= most:
        return torch.arange(points.shape[0])
    return torch.randperm(points.shape[0], generator=generator)[:most].sort().values


def color_points(
    points: Float[Tensor, "P 3"], views: list[tuple[Camera, UInt8[Tensor, "H W 3"], Bool[Tensor, "H W"]]]
) -> Float[Tensor, "P 3"]:
    """Mean colour in [0, 1] of the static pixels that each point falls on in some views; grey where no view sees it."""
    total, count = torch.zeros(points.shape[0], 3), torch.zeros(points.shape[0], 1)
    for camera, image, static in views:
        row, column, _, inside = camera.project(points)
        seen = (inside & static[row, column])[:, None]
        total += torch.where(seen, image[row, column].float() / 255.0, 0.0)
        count += seen
    return torch.where(count > 0, total / count.clamp_min(1), 0.5)


def lift(
    depth: Float[Tensor, "H W"],
    wanted: Bool[Tensor, "H W"],
    image: Float[Tensor, "H W 3"],
    camera: Camera,
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Positions and colours of the pixels that are wanted and have a depth."""
    row, column = (wanted & depth.isfinite()).nonzero(as_tuple=True)
    z = depth[row, column]
    return camera.unproject(row, column, z), image[row, column]
