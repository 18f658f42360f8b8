"""Gaussians from point clouds, and point clouds from depth."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import ModelConfig
from warpgs.model.gaussians import Gaussians

INITIAL_OPACITY = 0.1
NUM_NEIGHBOURS = 3

MIN_SCALE = 1e-7**0.5
"""Standard deviation of Gaussians at coincident points where sizes are not bounded; as in 3DGS [scene units]."""

BOX_MARGIN = 1.2
"""Size of the scene's box relative to that of its points."""


def gaussians_at(
    points: Float[Tensor, "N 3"],
    colors: Float[Tensor, "N 3"],
    model: ModelConfig,
    max_scale: float = math.inf,
) -> Gaussians:
    """Isotropic Gaussians, each as large as the root mean square distance to its three nearest neighbours (3DGS).

    Args:
        points: [N, 3] positions on the CPU.
        colors: [N, 3] in [0, 1].
        model: Degree of spherical harmonics, and whether sizes are bounded.
        max_scale: Maximum standard deviation, if sizes are bounded [scene units].
    """
    N = points.shape[0]
    if N <= NUM_NEIGHBOURS:
        scales = torch.full((N,), min(0.01, max_scale))
        return Gaussians.from_points(points, colors, scales, INITIAL_OPACITY, model.sh_degree)
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=NUM_NEIGHBOURS + 1, workers=-1)
    scales = torch.from_numpy(np.sqrt((distances[:, 1:] ** 2).mean(1))).float()
    if model.bound_sizes:
        # Coincident points would get scale 0, a few distant ones the size of the scene.
        typical = scales.median().clamp_min(1e-7)
        scales = scales.clamp(1e-3 * typical, 10.0 * typical).clamp_max(max_scale)
    else:
        scales = scales.clamp_min(MIN_SCALE)
    return Gaussians.from_points(points, colors, scales, INITIAL_OPACITY, model.sh_degree)


def scene_box(points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """(center, half size) of the cube that holds the points, except the outermost 1 % along each axis, with a margin.

    Without points, the cube from -1 to 1 that captures are normalized to.
    """
    if points.shape[0] < 2:
        return torch.zeros(3), torch.ones(3)
    ordered = points.sort(0).values
    last = points.shape[0] - 1
    low, high = ordered[round(0.005 * last)], ordered[round(0.995 * last)]
    # With one length for all axes, the encoding has the same frequencies along each of them.
    half_size = (0.5 * BOX_MARGIN * (high - low).max()).clamp_min(1e-3)
    return 0.5 * (low + high), half_size.expand(3).contiguous()


def random_points(points: Float[Tensor, "P 3"], count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """``count`` points, uniformly distributed in the box of other points."""
    center, half_size = scene_box(points)
    return center + half_size * (2.0 * torch.rand(count, 3, generator=generator) - 1.0)


def front_of_ball(offsets: Float[np.ndarray, "P D"]) -> Float[np.ndarray, " P"]:
    """How far in front of its centre the front of a ball is, at offsets of pixels from the centre.

    The ball is as wide as 95 % of the offsets; beyond, it is 0.
    """
    squared = (offsets**2).sum(1)
    return np.sqrt(np.maximum(np.quantile(squared, 0.95) - squared, 0.0))


def subsample(points: Tensor, max_count: int, generator: torch.Generator) -> Tensor:
    """Sorted indices of at most ``max_count`` random points."""
    if points.shape[0] <= max_count:
        return torch.arange(points.shape[0])
    return torch.randperm(points.shape[0], generator=generator)[:max_count].sort().values


def color_points(
    points: Float[Tensor, "P 3"], views: list[tuple[Camera, UInt8[Tensor, "H W 3"], Bool[Tensor, "H W"]]]
) -> Float[Tensor, "P 3"]:
    """Mean colour in [0, 1] of the pixels onto which each point projects in some views.

    Args:
        points: [P, 3] positions.
        views: Camera, [H, W, 3] image and [H, W] mask of the pixels that count.

    Returns:
        [P, 3]; grey for points that no view sees.
    """
    total, count = torch.zeros(points.shape[0], 3), torch.zeros(points.shape[0], 1)
    for camera, image, mask in views:
        row, column, _, inside = camera.project(points)
        counts = (inside & mask[row, column])[:, None]
        total += torch.where(counts, image[row, column].float() / 255.0, 0.0)
        count += counts
    return torch.where(count > 0, total / count.clamp_min(1), 0.5)


def unproject(
    depth: Float[Tensor, "H W"],
    mask: Bool[Tensor, "H W"],
    image: Float[Tensor, "H W 3"],
    camera: Camera,
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Positions and colours of the pixels in the mask that have a finite depth."""
    row, column = (mask & depth.isfinite()).nonzero(as_tuple=True)
    z = depth[row, column]
    return camera.unproject(row, column, z), image[row, column]
