"""Tile binning: the Gaussians of each tile, front to back (kernels/tiles.py)."""

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, int32, int64

from warpgs.kernels import tiles as kernels
from warpgs.kernels.constants import TILE_SIZE
from warpgs.kernels.lanes import BLOCK_DIM, WARP_SIZE
from warpgs.kernels.scan import SCAN_BLOCK_DIM
from warpgs.kernels.sort import MAX_PAIRS
from warpgs.runtime.launch import launch

from .rows import DEPTH_BITS, DepthOrder, Rows
from .sort import new_counters, sort_pairs

HEADROOM = 1.2
"""Buffers hold the recent maximum of intersections times this."""

DECAY = 0.999
"""Factor by which the recent maximum of intersections decreases per frame."""


class Tiles(NamedTuple):
    """The Gaussians of each tile of 16×16 pixels; tiles are in row-major order.

    Attributes:
        ranges: [num_tiles, 2] int32 begin and end of each tile's list in ``gaussian_from_isect``.
        gaussian_from_isect: int32, in its first half the Gaussian of each (Gaussian, tile) intersection, by tile, then
            front to back; longer than the end of the last range. With branches, the intersections of dynamic Gaussians
            have the bit ``kernels.DYNAMIC``, and the second half has the lists of each branch; see ``split_tiles``.
        branch_lengths: [num_tiles, 2] int32 number of static and of dynamic Gaussians of each tile, with branches.
        num_isects: [1] int64 number of intersections; in host memory if it was left to ``bin_splats`` how many to
            allocate, and valid there once the device has completed the binning.
    """

    ranges: Tensor
    gaussian_from_isect: Tensor
    branch_lengths: Tensor | None
    num_isects: Tensor

    @property
    def half(self) -> int:
        """Begin of the second half of ``gaussian_from_isect``."""
        return self.gaussian_from_isect.shape[0] // 2


class _Budget:
    """How many intersections to allocate buffers for on a GPU, learned from earlier frames of a size.

    The device writes each frame's number into pinned host memory; it is read a frame or more later, without waiting.
    A frame whose number exceeds its buffers is still rendered completely, on the slow path of the kernels.
    """

    def __init__(self) -> None:
        self.recent_max: float | None = None
        with torch.inference_mode(False):  # otherwise it could not be written to outside of inference mode
            self.num_isects = torch.zeros(1, dtype=int64, device="cpu", pin_memory=torch.cuda.is_available())
        self._number = self.num_isects.numpy()  # the same memory, which the host reads faster

    def capacity(self, num_gaussians: int) -> int:
        """Buffer size for the next frame, rounded up to an eighth of it so that the allocator sees few sizes."""
        self.recent_max = max(float(self._number[0]), (self.recent_max or 0.0) * DECAY)
        wanted = max(int(self.recent_max * HEADROOM), num_gaussians, 1024)
        step = 1 << max(wanted.bit_length() - 4, 0)
        return min(-(-wanted // step) * step, MAX_PAIRS - 1)


class _Budgets(threading.local):
    """The budgets of this thread, by device and size of the image."""

    def __init__(self) -> None:
        self.by_size: dict[tuple[int, tuple[int, int]], _Budget] = {}


_budgets = _Budgets()


def reset_budgets() -> None:
    """Forgets the numbers of intersections that this thread has learned, before another scene of the same size."""
    for budget in _budgets.by_size.values():  # which are kept, because a CUDA graph may write to them
        budget.recent_max = None


def _capacity(
    order: DepthOrder, size: tuple[int, int], max_intersections: int | None, count: Callable[[Tensor], None]
) -> tuple[int, Tensor]:
    """How many intersections to allocate buffers for, and where the device writes how many there are.

    Args:
        order, size, max_intersections: As in ``bin_splats``.
        count: Counts the intersections on a GPU and writes their number to a tensor.

    Raises:
        RuntimeError: If that is unknown during a CUDA graph capture, which must not wait for the device.
    """
    words, N = order.scan_words, order.keys.shape[0] // 2
    if max_intersections is not None:
        return max(max_intersections, N), words.new_empty(1)
    if not words.is_cuda:
        return max(int(words[-1]), N), words.new_empty(1)
    key = words.get_device(), size
    budget = _budgets.by_size.get(key)
    if budget is None or budget.recent_max is None:
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError(
                f"a CUDA graph captures the first render of {size[0]} x {size[1]} pixels on this thread: "
                "set RenderSettings.max_intersections, or render once before"
            )
        budget = _budgets.by_size.setdefault(key, budget or _Budget())
        count(budget.num_isects)
        torch.cuda.current_stream(words.device).synchronize()
        words.zero_()
    return budget.capacity(N), budget.num_isects


def num_tiles(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of the tiles that cover an image of ``width`` × ``height`` pixels."""
    return -(-width // TILE_SIZE), -(-height // TILE_SIZE)


def bin_splats(
    splat_rows: Rows,
    order: DepthOrder,
    size: tuple[int, int],
    is_dynamic: Tensor | None = None,
    max_intersections: int | None = None,
) -> Tiles:
    """Bins splats into the tiles of an image.

    Args:
        splat_rows, order: The N splats, from ``project_fwd``. ``order`` is used up: project again to bin again.
        size: (width, height) of the image [px].
        is_dynamic: [N] uint8 branches, to get the lists of each branch, too.
        max_intersections: For how many intersections to allocate buffers; with more, the lists are longer than
            necessary. By default, on a GPU, as many as earlier frames of this size needed: only the first one waits
            for the device.

    Raises:
        ValueError: If there are too many splats with branches, or too many splats or ``max_intersections`` to sort.
        RuntimeError: If the first frame of a size is captured in a CUDA graph without ``max_intersections``.
    """
    splats, grid = splat_rows.packed, num_tiles(*size)
    N, total = splats.shape[0], grid[0] * grid[1]
    if is_dynamic is not None and N >= kernels.MAX_WITH_BRANCHES:
        raise ValueError(f"with branches there must be fewer than {kernels.MAX_WITH_BRANCHES} Gaussians, got {N}")
    if N == 0 or total == 0:
        empty = splats.new_zeros(total, 2, dtype=int32)
        none, no_isects = splats.new_empty(1, dtype=int32), splats.new_zeros(1, dtype=int64)
        return Tiles(empty, none, None if is_dynamic is None else empty, no_isects)
    sort_pairs(order.keys, order.gaussian_from_rank, order.sort_counters, DEPTH_BITS)
    if not splats.is_cuda:  # on CUDA the kernel that emits intersections does that itself, see scan.py
        launch(kernels.count_tiles, N, splats, order.gaussian_from_rank, *grid, order.scan_words)
        torch.cumsum(order.scan_words, 0, out=order.scan_words)
    emit, num_bits = partial(_emit, splats, order, is_dynamic, grid), total.bit_length()
    capacity, num_isects = _capacity(order, size, max_intersections, lambda number: emit(0, (None,) * 3, number))
    isects = order.keys.new_empty(2 * capacity), order.keys.new_empty(2 * capacity)  # tile, Gaussian
    counters = new_counters(order.keys, capacity, num_bits)
    emit(capacity, (*isects, counters), num_isects)
    sort_pairs(*isects, counters, num_bits)
    return _lists(order, is_dynamic, total, isects, num_isects)


def _emit(
    splats: Tensor,
    order: DepthOrder,
    is_dynamic: Tensor | None,
    grid: tuple[int, int],
    capacity: int,
    sort_input: tuple[Tensor | None, Tensor | None, Tensor | None],
    num_isects: Tensor,
) -> None:
    """Writes the intersections of splats in their order, up to a capacity, and how many there are.

    ``sort_input`` is what it writes for the sort of intersections by tile: tiles, Gaussians and the zeros of counters.
    """
    N = splats.shape[0]
    num_ranks = order.scan_words.shape[0] * (SCAN_BLOCK_DIM if splats.is_cuda else 1)
    inputs = (splats, order.gaussian_from_rank, order.scan_words, is_dynamic, N, num_ranks, *grid, capacity)
    threads = num_ranks + kernels.NUM_FILL_THREADS
    launch(kernels.emit_isects, threads, *inputs, *sort_input, num_isects, block_dim=SCAN_BLOCK_DIM)


def _lists(
    order: DepthOrder, is_dynamic: Tensor | None, total: int, isects: tuple[Tensor, Tensor], num_isects: Tensor
) -> Tiles:
    """The lists of ``total`` tiles from sorted intersections."""
    N, capacity = order.keys.shape[0] // 2, isects[0].shape[0] // 2
    ranges = order.keys.new_empty(total, 2)
    ranks = order.gaussian_from_rank, order.scan_words, is_dynamic
    launch(kernels.tile_ranges, max(capacity, total) + 1, *ranks, N, total, capacity, *isects, ranges)
    tiles = Tiles(ranges, isects[1], None if is_dynamic is None else torch.empty_like(ranges), num_isects)
    if is_dynamic is not None:
        threads = total * (WARP_SIZE if ranges.is_cuda else 1)
        launch(kernels.split_tiles, threads, ranges, tiles.half, *tiles[1:3], block_dim=BLOCK_DIM)
    return tiles
