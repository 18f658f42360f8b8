"""Truncated signed distances to surfaces, fused from depth images into blocks of voxels (Curless and Levoy 1996).

A voxel at depth z of a camera that sees depth d there gets min(1, (d − z) / truncation), unless it is hidden by more
than the truncation; its value is the mean over all cameras. Only blocks near depth that was seen are kept (Nießner et
al. 2013), so that memory grows with the area of surfaces, not with the volume of the scene.

torch does that in a few operations on every device. Open3D has the same, but its package takes 400 MB; Warp's and
scikit-image's marching cubes need dense arrays, which ``surface.py`` gives them window by window.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from .depth_views import DepthView

SIDE = 8
"""Voxels along each side of a block."""

TRUNCATION = 4.0
"""Distance from a surface at which values end [voxels]."""

MAX_FINER = 8
"""Maximum number of voxels along a pixel: depth images say nothing about finer ones, of which there are too many."""

CHUNK = 128
"""Blocks that are computed at once: more do not fit in the caches of a processor."""

OFFSETS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""A cell needs the voxels of its upper corners, which may be of the next block [voxels]."""

MAX_INDEX = 1 << 20
"""Bound on the indices of blocks along each axis: three of them fit in 63 bits."""


class Field(NamedTuple):
    """Signed distances; voxel i, a vector of integers, is at i times the size of a voxel.

    Attributes:
        voxel: Size of a voxel [scene units].
        blocks: [B, 3] indices of the blocks: block b has the voxels 8 b to 8 b + 7.
        values: [B, 512] signed distances in truncations, positive in front of surfaces; the last axis varies fastest.
        weights: [B, 512] number of cameras that know the value; 0 where it is unknown.
    """

    voxel: float
    blocks: Int64[Tensor, "B 3"]
    values: Float[Tensor, "B V"]
    weights: Float[Tensor, "B V"]


def blocks_near(views: Iterable[DepthView], voxel: float) -> Int64[Tensor, "B 3"]:
    """[B, 3] indices of the blocks within the truncation of what at least one view sees."""
    keys = [_keys(view, voxel) for view in views]
    return _unpacked(torch.unique(torch.cat(keys)))


def fitting_blocks(
    views: Sequence[DepthView], max_voxels: int, voxel: float | None = None
) -> tuple[float, Int64[Tensor, "B 3"]]:
    """The size of voxels [scene units], and the blocks near what views see.

    Args:
        views: At least one.
        max_voxels: Maximum number of voxels.
        voxel: The size; by default the smallest that needs no more voxels and is no smaller than a pixel (1 where
            nothing is seen).

    Raises:
        ValueError: If ``voxel`` needs more voxels, or is smaller than a pixel by far.
    """
    pixel = finest(views)
    if voxel is not None and pixel is not None and voxel < pixel / MAX_FINER:
        raise ValueError(f"--voxel {voxel:g} is finer than the images: use {1.05 * pixel / MAX_FINER:.2g} or larger")
    size, blocks = coarsened_blocks(views, max_voxels, voxel or pixel or 1.0)
    if voxel is not None and size > voxel:
        asked = len(blocks_near(views, voxel)) * SIDE**3
        raise ValueError(
            f"--voxel {voxel:g} needs {asked:,} voxels, more than the maximum of {max_voxels:,}: "
            f"use {1.05 * size:.2g} or larger"
        )
    return size, blocks


def coarsened_blocks(views: Iterable[DepthView], max_voxels: int, voxel: float) -> tuple[float, Int64[Tensor, "B 3"]]:
    """As ``fitting_blocks``, of a size of voxels, or a larger one if that needs too many."""
    blocks = blocks_near(views, voxel)
    while (excess := len(blocks) * SIDE**3 / max_voxels) > 1.0:
        voxel *= max(1.05, math.sqrt(excess))  # surfaces have a number of voxels that falls with the square
        blocks = blocks_near(views, voxel)
    return voxel, blocks


def finest(views: Iterable[DepthView]) -> float | None:
    """Median size of what a pixel shows [scene units]; None where nothing is seen."""
    sizes = torch.cat([view.depth[view.depth > 0][::16] / view.camera.focal for view in views])
    return float(sizes.median()) if len(sizes) else None


def fuse(views: Iterable[DepthView], voxel: float, blocks: Int64[Tensor, "B 3"]) -> Field:
    """Fuses depth images in blocks of voxels of a size [scene units]."""
    values = torch.zeros(len(blocks), SIDE**3, device=blocks.device, dtype=torch.float32)
    weights = torch.zeros_like(values)
    corners = torch.cartesian_prod(*[torch.tensor([0, SIDE // 2, SIDE - 1], device=blocks.device)] * 3)
    voxels = torch.cartesian_prod(*[torch.arange(SIDE, device=blocks.device)] * 3)
    for view in views:
        is_seen = view.camera.project(_points(blocks, corners, voxel))[3].view(len(blocks), len(corners)).any(1)
        for rows in is_seen.nonzero()[:, 0].split(CHUNK):
            value, known = _values(view, _points(blocks[rows], voxels, voxel), TRUNCATION * voxel)
            values[rows] += value.view(-1, SIDE**3)
            weights[rows] += known.view(-1, SIDE**3)
    return Field(voxel, blocks, values / weights.clamp_min(1.0), weights)


def _points(blocks: Int64[Tensor, "B 3"], inside: Int64[Tensor, "V 3"], voxel: float) -> Float[Tensor, "P 3"]:
    """Positions of the same voxels of all blocks [scene units]."""
    return ((SIDE * blocks[:, None] + inside).float() * voxel).view(-1, 3)


def _values(
    view: DepthView, points: Float[Tensor, "P 3"], truncation: float
) -> tuple[Float[Tensor, " P"], Bool[Tensor, " P"]]:
    """What a view says about points: their values, 0 where it says nothing, and whether it says anything."""
    row, column, depth, is_seen = view.camera.project(points)
    found = view.depth[row, column]
    distance = (found - depth) / truncation
    known = is_seen & (found > 0) & (distance > -1.0)
    return torch.where(known, distance.clamp_max(1.0), 0.0), known


def _keys(view: DepthView, voxel: float) -> Int64[Tensor, " K"]:
    """Keys of the blocks within the truncation of what a view sees."""
    row, column = view.depth.nonzero().unbind(1)
    depth = view.depth[row, column]
    keys = [row[:0]]
    for shift in (-TRUNCATION, 0.0, TRUNCATION):
        points = view.camera.unproject(row, column, (depth + shift * voxel).clamp_min(0.0)) / voxel
        points = points[points.isfinite().all(1)]
        keys += [torch.unique(_packed((points + points.new_tensor(offset)) / SIDE)) for offset in OFFSETS]
    return torch.unique(torch.cat(keys))


def _packed(positions: Float[Tensor, "P 3"]) -> Int64[Tensor, " P"]:
    """One integer for each block that positions, in blocks, lie in."""
    index = positions.floor().clamp(-MAX_INDEX, MAX_INDEX - 1).long() + MAX_INDEX
    return (index[:, 0] * 2 * MAX_INDEX + index[:, 1]) * 2 * MAX_INDEX + index[:, 2]


def _unpacked(keys: Int64[Tensor, " B"]) -> Int64[Tensor, "B 3"]:
    """The indices of blocks; the inverse of ``_packed``."""
    parts = (keys // (2 * MAX_INDEX) ** 2, keys // (2 * MAX_INDEX) % (2 * MAX_INDEX), keys % (2 * MAX_INDEX))
    return torch.stack(parts, 1) - MAX_INDEX
