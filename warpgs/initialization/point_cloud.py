"""Gaussians from point clouds, and point clouds from depth."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.model.gaussians import Gaussians

INITIAL_OPACITY = 0.1
NUM_NEIGHBOURS = 3

FEW_POINTS_SCALE = 0.01
"""Standard deviation of Gaussians at so few points that their distances say nothing [scene units]; where there is a
maximum, it is half of that."""

COINCIDENT = 1e-6
"""Distance between points that coincide, relative to the median of their largest coordinates: merged clouds contain
points several times, up to rounding to single precision."""

MAX_CELL = 2.0**62
"""Maximum coordinate of a cell, which must fit an int64."""

CELL_HASH = np.array([0x1E3779B97F4A7C15, 0x42B2AE3D27D4EB4F, 0x165667B19E3779F9])
"""Odd factors, whose products with a cell's coordinates add up to its hash, modulo 2^64."""

BOX_MARGIN = 1.2
"""Size of the scene's box relative to that of its points."""


def gaussians_at(
    points: Float[Tensor, "N 3"],
    colors: Float[Tensor, "N 3"],
    sh_degree: int,
    max_scale: float = math.inf,
    resolution: float = 0.0,
) -> Gaussians:
    """Isotropic Gaussians, each as large as the root mean square distance to its three nearest neighbours (3DGS).

    Points at one place count as one neighbour, and get the same size: 3DGS would give them none.

    Args:
        points: [N, 3] positions on the CPU.
        colors: [N, 3] in [0, 1].
        sh_degree: Degree of spherical harmonics.
        max_scale: Maximum standard deviation [scene units].
        resolution: What cameras resolve: closer points are at one place, and no Gaussian is smaller [scene units].
    """
    first, place = distinct(points, resolution)
    if len(first) <= NUM_NEIGHBOURS:
        scale = 0.5 * max_scale if math.isfinite(max_scale) else FEW_POINTS_SCALE
        scales = torch.full((points.shape[0],), scale, dtype=torch.float32)
        return Gaussians.from_points(points, colors, scales, INITIAL_OPACITY, sh_degree)
    places = points[first].numpy()
    distances, _ = cKDTree(places).query(places, k=NUM_NEIGHBOURS + 1, workers=-1)
    scales = torch.from_numpy(np.sqrt((distances[:, 1:] ** 2).mean(1))).float()
    # Of points that nearly coincide and of a few distant ones, distances are no sizes.
    typical = scales.median().clamp_min(1e-7)
    scales = scales.clamp(1e-3 * typical, 10.0 * typical).clamp_min(resolution).clamp_max(max_scale)
    return Gaussians.from_points(points, colors, scales[place], INITIAL_OPACITY, sh_degree)


def distinct(points: Float[Tensor, "N 3"], resolution: float = 0.0) -> tuple[Int64[Tensor, " D"], Int64[Tensor, " N"]]:
    """Sorted indices of one point at each place, and the number of each point's place among them.

    Args:
        points: [N, 3] positions.
        resolution: Distance below which points are at one place [scene units].
    """
    values = points.detach().cpu().numpy().astype(np.float64)
    sizes = np.abs(values).max(1, initial=0.0)
    radius = max(resolution, COINCIDENT * float(np.median(sizes[sizes > 0.0])) if sizes.any() else 1.0)
    cells = np.rint(values / radius).clip(-MAX_CELL, MAX_CELL).astype(np.int64)
    # Of a million cells, two share a hash with a probability of 1e-7; their points would share a size.
    _, first = np.unique((cells * CELL_HASH).sum(1), return_index=True)
    first.sort()
    # A place may lie on the border of cells. Chains of close points do not become one place.
    pairs = cKDTree(values[first]).query_pairs(radius, output_type="ndarray")
    first = np.delete(first, np.unique(pairs.max(1)))
    place = cKDTree(values[first]).query(values, workers=-1)[1] if len(first) < len(values) else first
    return torch.from_numpy(first), torch.from_numpy(place)


def scene_box(points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """(center, half size) of the cube that holds the points, except the outermost 1 % along each axis, with a margin.

    Points at one place count once. Without two places, the cube from -1 to 1 that captures are normalized to.
    """
    points = points[distinct(points)[0]]
    if points.shape[0] < 2:
        return torch.zeros(3, dtype=torch.float32), torch.ones(3, dtype=torch.float32)
    ordered = points.sort(0).values
    last = points.shape[0] - 1
    low, high = ordered[round(0.005 * last)], ordered[round(0.995 * last)]
    # With one length for all axes, the encoding has the same frequencies along each of them.
    half_size = (0.5 * BOX_MARGIN * (high - low).max()).clamp_min(1e-3)
    return 0.5 * (low + high), half_size.expand(3).contiguous()


def random_points(points: Float[Tensor, "P 3"], count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """``count`` points, uniformly distributed in the box of other points."""
    center, half_size = scene_box(points)
    return center + half_size * (2.0 * torch.rand(count, 3, dtype=torch.float32, generator=generator) - 1.0)


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
    total, count = (
        torch.zeros(points.shape[0], 3, dtype=torch.float32),
        torch.zeros(points.shape[0], 1, dtype=torch.float32),
    )
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
    points = camera.unproject(row, column, depth[row, column])
    is_seen = points.isfinite().all(1)
    return points[is_seen], image[row, column][is_seen]


def filled(count: int, value: float) -> Float[Tensor, " P"]:
    """[P] the same number in single precision, whatever torch's default type is."""
    return torch.full((count,), value, dtype=torch.float32)
