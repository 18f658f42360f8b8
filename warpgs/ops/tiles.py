"""Tile binning: the Gaussians of each tile, front to back (kernels/tiles.py)."""

import threading
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor, int32, int64

from warpgs.kernels import tiles as kernels
from warpgs.kernels.constants import TILE_SIZE
from warpgs.kernels.lanes import BLOCK_DIM, WARP_SIZE
from warpgs.runtime.tape import OpContext, pinned_counter

from .rows import Rows

HEADROOM = 1.2
"""Buffers hold the recent maximum of intersections times this."""

DECAY = 0.999
"""Factor by which the recent maximum of intersections decreases per frame."""

DEPTH_BITS = 31


class Tiles(NamedTuple):
    """The Gaussians of each tile of 16×16 pixels; tiles are in row-major order.

    Attributes:
        ranges: [num_tiles, 2] int32 begin and end of each tile's list in ``gaussian_from_isect``.
        gaussian_from_isect: int32, in its first half the Gaussian of each (Gaussian, tile) intersection, by tile, then
            front to back; longer than the end of the last range. With branches, the intersections of dynamic Gaussians
            have the bit ``kernels.DYNAMIC``, and the second half has the lists of each branch; see ``split_tiles``.
        branch_lengths: [num_tiles, 2] int32 number of static and of dynamic Gaussians of each tile, with branches.
        demand: [1] int64 number of intersections, in host memory; valid once the device has completed the binning.
    """

    ranges: Tensor
    gaussian_from_isect: Tensor
    branch_lengths: Tensor | None
    demand: Tensor

    @property
    def half(self) -> int:
        """Begin of the second half of ``gaussian_from_isect``."""
        return len(self.gaussian_from_isect) // 2


@dataclass
class _Budget:
    """How many intersections to allocate buffers for, learned from earlier frames.

    The device writes each frame's demand into pinned host memory; it is read a frame or more later, without waiting.
    A frame whose demand exceeds its buffers is still rendered completely, on the slow path of the kernels.
    """

    device: torch.device
    recent_max: float | None = None
    last: int = 0
    demand: Tensor = field(init=False)

    def __post_init__(self) -> None:
        with torch.inference_mode(False):  # otherwise it could not be written to outside of inference mode
            self.demand = pinned_counter(self.device)

    def capacity(self, num_gaussians: int) -> int:
        """Buffer size for the next frame, rounded up to an eighth of it so that the allocator sees few sizes."""
        self.last = int(self.demand.item())
        self.recent_max = max(float(self.last), (self.recent_max or 0.0) * DECAY)
        wanted = max(int(self.recent_max * HEADROOM), num_gaussians, 1024)
        step = 1 << max(wanted.bit_length() - 4, 0)
        return -(-wanted // step) * step

    def fits(self, capacity: int, num_gaussians: int) -> bool:
        """Whether buffers of a capacity hold the last demand, and are not much larger than the next ones would be."""
        max_capacity = 2 * self.capacity(num_gaussians)  # reads the last demand, too
        return self.last <= capacity <= max_capacity


_budgets = threading.local()


def _budget(device: torch.device, width: int, height: int) -> _Budget:
    cache = _budgets.__dict__.setdefault("cache", {})
    key = (device, width, height)
    if key not in cache:
        cache[key] = _Budget(device)
    return cache[key]


def reset_budgets() -> None:
    """Forgets the numbers of intersections that this thread has learned, before another scene of the same size."""
    _budgets.__dict__.clear()


def num_tiles(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of the tiles that cover an image of ``width`` × ``height`` pixels."""
    return -(-width // TILE_SIZE), -(-height // TILE_SIZE)


class _Sorted(NamedTuple):
    """N > 0 splats in order of depth, to be binned into ``columns`` × ``rows`` > 0 tiles."""

    splats: Tensor
    gaussian_from_rank: Tensor
    end_of_rank: Tensor
    is_dynamic: Tensor | None
    columns: int
    rows: int


def record_tiles(ctx: OpContext, splat_rows: Rows, size: tuple[int, int], is_dynamic: Tensor | None = None) -> Tiles:
    """Bins splats into the tiles of an image as a part of a larger op.

    Waits for the device only on the first frame of a size; later frames allocate what earlier ones needed.

    Args:
        ctx: Of the op.
        splat_rows: The N splats; features are not needed.
        size: (width, height) of the image [px].
        is_dynamic: [N] uint8 branches, to get the lists of each branch, too.

    Raises:
        ValueError: If there are too many splats with branches.
    """
    N, columns, rows = len(splat_rows.packed), *num_tiles(*size)
    if is_dynamic is not None and N >= kernels.MAX_WITH_BRANCHES:
        raise ValueError(f"with branches there must be fewer than {kernels.MAX_WITH_BRANCHES} Gaussians, got {N}")
    if N == 0 or columns * rows == 0:
        empty = ctx.zeros(columns * rows, 2, dtype=int32)
        demand = torch.zeros(1, dtype=int64)
        return Tiles(empty, ctx.empty(1, dtype=int32), None if is_dynamic is None else empty, demand)
    splats = _sort(ctx, splat_rows, columns, rows, is_dynamic)
    budget = _budget(ctx.device, *size)
    if budget.recent_max is None or not ctx.is_cuda:
        budget.demand.copy_(splats.end_of_rank[-1:])
    capacity = budget.capacity(N) if ctx.is_cuda else max(int(budget.demand.item()), N)
    ctx.replay_conditions.append(lambda: budget.fits(capacity, N))
    ranges, gaussian_from_isect = _bin(ctx, splats, capacity, budget.demand)
    lengths = None if is_dynamic is None else torch.empty_like(ranges)
    tiles = Tiles(ranges, gaussian_from_isect, lengths, budget.demand)
    if lengths is not None:
        threads = columns * rows * (WARP_SIZE if ctx.is_cuda else 1)
        ctx.launch(kernels.split_tiles, threads, ranges, tiles.half, gaussian_from_isect, lengths, block_dim=BLOCK_DIM)
    return tiles


def _sort(ctx: OpContext, splat_rows: Rows, columns: int, rows: int, is_dynamic: Tensor | None) -> _Sorted:
    """Sorts splats by depth and counts the intersections of each one and all in front of it."""
    splats, gaussian_from_rank = splat_rows.packed, splat_rows.gaussian_from_rank
    N = len(splats)
    ctx.sort_pairs(splat_rows.depth_keys, gaussian_from_rank, N, DEPTH_BITS)
    end_of_rank = ctx.empty(N, dtype=int64)
    ctx.launch(kernels.count_tiles, N, splats, gaussian_from_rank, columns, rows, end_of_rank)
    torch.cumsum(end_of_rank, 0, out=end_of_rank)
    return _Sorted(splats, gaussian_from_rank, end_of_rank, is_dynamic, columns, rows)


def _bin(ctx: OpContext, sorted_splats: _Sorted, capacity: int, demand: Tensor) -> tuple[Tensor, Tensor]:
    """Fills buffers of ``capacity`` intersections; returns ``ranges`` and ``gaussian_from_isect`` of ``Tiles``."""
    splats, gaussian_from_rank, end_of_rank, is_dynamic, columns, rows = sorted_splats
    N, total = len(splats), columns * rows
    isects = ctx.empty(2 * capacity, dtype=int32), ctx.empty(2 * capacity, dtype=int32)  # tile, Gaussian
    sizes = (N, columns, rows, capacity)
    threads = max(N, capacity)
    inputs = (splats, gaussian_from_rank, end_of_rank, is_dynamic)
    ctx.launch(kernels.emit_isects, threads, *inputs, *sizes, *isects, demand)
    ctx.sort_pairs(*isects, capacity, total.bit_length())
    ranges = ctx.empty(total, 2, dtype=int32)
    threads = max(capacity, total) + 1
    order = (end_of_rank, gaussian_from_rank, is_dynamic)
    ctx.launch(kernels.tile_ranges, threads, *order, N, total, capacity, *isects, ranges)
    return ranges, isects[1]
