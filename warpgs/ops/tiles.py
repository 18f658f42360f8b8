"""Tile binning: each tile's Gaussians, front to back (kernels/tiles.py)."""

import threading
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from warpgs.kernels import tiles as kernels
from warpgs.kernels.constants import TILE_SIZE
from warpgs.kernels.lanes import BLOCK_DIM, WARP_SIZE
from warpgs.runtime.tape import Run, pinned_counter

from .rows import Rows

HEADROOM = 1.2
"""Buffers hold this many times the most intersections seen lately."""

DECAY = 0.999
"""Per frame, what was seen earlier counts this much less."""

DEPTH_BITS = 31


class Tiles(NamedTuple):
    """Which Gaussians each tile of 16×16 pixels looks at, in row-major order of tiles.

    Attributes:
        ranges: [num_tiles, 2] int32 begin and end of each tile's run in ``gaussian_from_isect``.
        gaussian_from_isect: int32, in its first half the Gaussian of each (Gaussian, tile) intersection, by tile, then
            front to back; longer than the last range's end. With branches, those of dynamic ones have the bit
            ``kernels.DYNAMIC``, and the second half has the lists of each branch alone (``kernels.split_tiles``).
        branch_lengths: [num_tiles, 2] int32 number of static and of dynamic Gaussians of each tile, with branches.
        demand: [1] int64 number of intersections, in host memory; valid once the device has come this far.
    """

    ranges: Tensor
    gaussian_from_isect: Tensor
    branch_lengths: Tensor | None
    demand: Tensor

    @property
    def half(self) -> int:
        """Where the second half of ``gaussian_from_isect`` begins."""
        return len(self.gaussian_from_isect) // 2


@dataclass
class _Budget:
    """How many intersections to provide for, learned from the frames before.

    The device writes each frame's demand into pinned host memory; it is read a frame or more later, without waiting.
    A frame whose demand turns out larger than its buffers is still drawn in full, by the kernels' slow way.
    """

    device: torch.device
    most: float | None = None
    last: int = 0
    demand: Tensor = field(init=False)

    def __post_init__(self) -> None:
        with torch.inference_mode(False):  # else nothing outside of that mode could write to it
            self.demand = pinned_counter(self.device)

    def capacity(self, num_gaussians: int) -> int:
        """Buffer size for the next frame, in steps of an eighth so that the allocator sees few sizes."""
        self.last = int(self.demand.item())
        self.most = max(float(self.last), (self.most or 0.0) * DECAY)
        wanted = max(int(self.most * HEADROOM), num_gaussians, 1024)
        step = 1 << max(wanted.bit_length() - 4, 0)
        return -(-wanted // step) * step

    def fits(self, capacity: int, num_gaussians: int) -> bool:
        """Whether buffers of a size hold what was needed last, and not much more than will be."""
        most_fitting = 2 * self.capacity(num_gaussians)
        return self.last <= capacity <= most_fitting


_budgets = threading.local()


def _budget(device: torch.device, width: int, height: int) -> _Budget:
    cache = _budgets.__dict__.setdefault("cache", {})
    key = (device, width, height)
    if key not in cache:
        cache[key] = _Budget(device)
    return cache[key]


def forget_budgets() -> None:
    """Forgets what this thread has learned of intersections, for who goes on with another scene of the same size."""
    _budgets.__dict__.clear()


def num_tiles(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return -(-width // TILE_SIZE), -(-height // TILE_SIZE)


def record_tiles(run: Run, splat_rows: Rows, size: tuple[int, int], is_dynamic: Tensor | None = None) -> Tiles:
    """Bins splats into the tiles of an image of ``size`` (width, height), with ``is_dynamic`` [N] uint8 by branch, too.

    Waits for the device only on the first frame of a size; later frames provide for what earlier ones needed.

    Raises:
        ValueError: If there are too many splats with branches.
    """
    rows, gaussian_from_rank = splat_rows.packed, splat_rows.gaussian_from_rank
    N = rows.shape[0]
    tiles_x, tiles_y = num_tiles(*size)
    total = tiles_x * tiles_y
    int32 = torch.int32
    if is_dynamic is not None and N >= kernels.MAX_WITH_BRANCHES:
        raise ValueError(f"with branches there must be fewer than {kernels.MAX_WITH_BRANCHES} Gaussians, got {N}")
    if N == 0 or total == 0:
        nothing = run.zeros(total, 2, dtype=int32)
        demand = torch.zeros(1, dtype=torch.int64)
        return Tiles(nothing, run.empty(1, dtype=int32), None if is_dynamic is None else nothing, demand)
    run.sort_pairs(splat_rows.depth_keys, gaussian_from_rank, N, DEPTH_BITS)
    end_of_rank = run.empty(N, dtype=torch.int64)
    run.launch(kernels.count_tiles, N, rows, gaussian_from_rank, tiles_x, tiles_y, end_of_rank)
    torch.cumsum(end_of_rank, 0, out=end_of_rank)

    budget = _budget(run.device, *size)
    if budget.most is None or not run.is_cuda:
        budget.demand.copy_(end_of_rank[-1:])
    capacity = budget.capacity(N) if run.is_cuda else max(int(budget.demand.item()), N)
    run.conditions.append(lambda: budget.fits(capacity, N))
    tile_from_isect, gaussian_from_isect = run.empty(2 * capacity, dtype=int32), run.empty(2 * capacity, dtype=int32)
    run.launch(
        kernels.emit_isects,
        max(N, capacity),
        rows,
        gaussian_from_rank,
        end_of_rank,
        is_dynamic,
        N,
        tiles_x,
        tiles_y,
        capacity,
        tile_from_isect,
        gaussian_from_isect,
        budget.demand,
    )
    run.sort_pairs(tile_from_isect, gaussian_from_isect, capacity, total.bit_length())
    ranges = run.empty(total, 2, dtype=int32)
    run.launch(
        kernels.tile_ranges,
        max(capacity, total) + 1,
        end_of_rank,
        gaussian_from_rank,
        is_dynamic,
        N,
        total,
        capacity,
        tile_from_isect,
        gaussian_from_isect,
        ranges,
    )
    tiles = Tiles(ranges, gaussian_from_isect, None if is_dynamic is None else torch.empty_like(ranges), budget.demand)
    if tiles.branch_lengths is not None:
        run.launch(
            kernels.split_tiles,
            total * (WARP_SIZE if run.is_cuda else 1),
            ranges,
            tiles.half,
            gaussian_from_isect,
            tiles.branch_lengths,
            block_dim=BLOCK_DIM,
        )
    return tiles
