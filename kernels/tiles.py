"""Tile binning: the list of Gaussians that each tile composites, front to back.

Gaussians are sorted by depth once (N keys of 32 bits); in that order each writes one intersection per tile that its
ellipse exactly intersects; a stable sort by tile index (M keys, as few passes as a tile index needs) then leaves the
intersections of every tile in depth order.

The buffers hold ``capacity`` intersections. The actual number M is only known on the device, and the host does not wait
for it: unused intersections have the tile index ``num_tiles`` and are sorted to the end, and if M > capacity every tile
composites all Gaussians in depth order instead, which is slower but gives the same image. M is written to ``demand`` in
host memory, which the next call reads to size its buffers.

For images of one branch alone, an intersection stores the branch of its Gaussian, and ``split_tiles`` splits the list
of each tile into two.
"""

import warp as wp

from .constants import CULLED_LOG2_OPACITY, LOG2_ALPHA_MIN, TILE_SIZE
from .ellipse import ellipse_half_size, ellipse_slab
from .lanes import lane_ballot, lane_bit_count, lane_broadcast, lane_count, lane_lowest, lane_rank, lane_sum_before
from .rows import row_load
from .scan import prefix_sums, stored_sum, wait_for_sum

SLACK = wp.constant(0.01)
"""Spans are widened by this [px], well above the rounding error of float32 at 8K, so that no intersection is missed."""


MANY_TILES = wp.constant(24)
"""A Gaussian with more intersections than this is written by a whole lane group instead of one thread."""


NUM_FILL_THREADS = wp.constant(8192)
"""Threads that give the unused intersections their tile index, and write the zeros that the sort by tile needs."""


DYNAMIC = wp.constant(1 << 30)
"""With branches, this bit of an intersection is set if its Gaussian is dynamic; the other bits are the Gaussian's
index. Looking the branch up for every intersection would read scattered memory."""

MAX_WITH_BRANCHES = 1 << 29
"""With branches, the number of Gaussians must be below this: a list position shares an int with two other bits."""


BATCH_SIZE = wp.constant(4)
"""Intersections that a lane loads at once when tiles are split, so that the loads overlap."""

Batch = wp.types.vector(length=BATCH_SIZE, dtype=int)


@wp.func
def make_isect(g: int, is_dynamic: wp.array[wp.uint8]) -> int:
    """The int that represents a Gaussian in its intersections; without branches it is its index."""
    isect = g
    if is_dynamic.shape[0] > 0:
        isect = g | (int(is_dynamic[g] != wp.uint8(0)) * DYNAMIC)
    return isect


@wp.func
def tile_index(position: float, num_tiles: int) -> int:
    """Tile of a pixel coordinate, clamped to at most one tile outside the image."""
    return int(wp.clamp(wp.floor(position / float(TILE_SIZE)), -1.0, float(num_tiles)))


@wp.func
def tile_rows(row0: wp.vec4, half_size: wp.vec2, tiles_y: int) -> wp.vec2i:
    """First and one past the last row of tiles with a pixel centre in the ellipse's bounding box.

    Tile k has pixel centres from 16 k + 0.5 to 16 k + 15.5, so the box is shrunk by half a pixel on both sides.
    """
    low = tile_index(row0[1] - half_size[1] + 0.5 - SLACK, tiles_y)
    high = tile_index(row0[1] + half_size[1] - 0.5 + SLACK, tiles_y)
    return wp.vec2i(wp.max(low, 0), wp.min(high, tiles_y - 1) + 1)


@wp.func
def tile_columns(row0: wp.vec4, row1: wp.vec4, half_size: wp.vec2, tile_y: int, tiles_x: int) -> wp.vec2i:
    """First and one past the last tile that the ellipse intersects in one row of tiles."""
    top = float(tile_y * TILE_SIZE) + 0.5 - row0[1]
    slab = ellipse_slab(
        row0[2], row0[3], row1[0], row1[1] - LOG2_ALPHA_MIN, half_size, top - SLACK, top + float(TILE_SIZE - 1) + SLACK
    )
    low = tile_index(row0[0] + slab[0] + 0.5 - SLACK, tiles_x)
    high = tile_index(row0[0] + slab[1] - 0.5 + SLACK, tiles_x)
    return wp.vec2i(wp.max(low, 0), wp.min(high, tiles_x - 1) + 1)


@wp.func
def num_tiles_of(rows: wp.array2d[wp.vec4], g: int, tiles_x: int, tiles_y: int) -> int:
    """Number of tiles that a Gaussian's ellipse intersects."""
    count = int(0)
    row0 = row_load(rows, g, 0)
    row1 = row_load(rows, g, 1)
    if row1[1] != CULLED_LOG2_OPACITY:
        half_size = ellipse_half_size(row0[2], row0[3], row1[0], row1[1] - LOG2_ALPHA_MIN)
        span_y = tile_rows(row0, half_size, tiles_y)
        for y in range(span_y[0], span_y[1]):
            span_x = tile_columns(row0, row1, half_size, y, tiles_x)
            count += wp.max(span_x[1] - span_x[0], 0)
    return count


@wp.kernel(enable_backward=False)
def count_tiles(
    first: int,
    rows: wp.array2d[wp.vec4],
    gaussian_from_rank: wp.array[int],
    tiles_x: int,
    tiles_y: int,
    num_tiles_of_rank: wp.array[wp.int64],
):
    """On CPU only, see ``scan``."""
    rank = first + wp.tid()
    num_tiles_of_rank[rank] = wp.int64(num_tiles_of(rows, gaussian_from_rank[rank], tiles_x, tiles_y))


# With Warp's grid-stride loop the grid is one-dimensional, as the prefix sum needs it, and has a thread for each index.
@wp.kernel(enable_backward=False, grid_stride=True)
def emit_isects(
    first: int,
    rows: wp.array2d[wp.vec4],
    gaussian_from_rank: wp.array[int],
    scan_words: wp.array[wp.int64],
    is_dynamic: wp.array[wp.uint8],
    num_gaussians: int,
    num_ranks: int,
    tiles_x: int,
    tiles_y: int,
    capacity: int,
    tile_from_isect: wp.array[int],
    gaussian_from_isect: wp.array[int],
    sort_counters: wp.array[int],
    demand: wp.array[wp.int64],
):
    """Launched with ``num_ranks`` threads, ``num_gaussians`` rounded up to whole blocks, and ``NUM_FILL_THREADS`` more.

    With the capacity 0 it only counts.
    """
    thread = first + wp.tid()
    if thread >= num_ranks:
        for k in range(thread - num_ranks, sort_counters.shape[0], NUM_FILL_THREADS):
            sort_counters[k] = 0
        total = wait_for_sum(scan_words)
        if thread == num_ranks:
            demand[0] = total
        for unused in range(int(wp.min(total, wp.int64(capacity))) + thread - num_ranks, capacity, NUM_FILL_THREADS):
            tile_from_isect[unused] = tiles_x * tiles_y
        return
    lane = thread % lane_count()
    g = int(0)
    count = int(0)
    gaussian = int(0)  # see make_isect
    if thread < num_gaussians:
        g = gaussian_from_rank[thread]
        gaussian = make_isect(g, is_dynamic)
        if lane_count() > 1:  # on CPU, count_tiles has counted
            count = num_tiles_of(rows, g, tiles_x, tiles_y)
    sums = prefix_sums(count, thread, scan_words)
    isect = int(wp.min(sums[0], wp.int64(capacity)))
    end = int(wp.min(sums[1], wp.int64(capacity)))
    many = int(end - isect > MANY_TILES)
    if end > isect and many == 0:
        row0 = row_load(rows, g, 0)
        row1 = row_load(rows, g, 1)
        half_size = ellipse_half_size(row0[2], row0[3], row1[0], row1[1] - LOG2_ALPHA_MIN)
        span_y = tile_rows(row0, half_size, tiles_y)
        for y in range(span_y[0], span_y[1]):
            span_x = tile_columns(row0, row1, half_size, y, tiles_x)
            for x in range(span_x[0], span_x[1]):
                # Rounding may differ from that of the count: never write past it.
                if isect < end:
                    tile_from_isect[isect] = y * tiles_x + x
                    gaussian_from_isect[isect] = gaussian
                    isect += 1
        while isect < end:
            tile_from_isect[isect] = tiles_x * tiles_y
            gaussian_from_isect[isect] = gaussian
            isect += 1
    # Gaussians with many tiles are written by the whole lane group, one after the other: with a single thread, the
    # whole launch would wait for the few Gaussians that cover the image.
    ballot = lane_ballot(many)
    while ballot != wp.uint32(0):
        writer = lane_lowest(ballot)
        ballot = ballot & (ballot - wp.uint32(1))
        big_g = lane_broadcast(g, writer)
        big_gaussian = lane_broadcast(gaussian, writer)
        big_isect = lane_broadcast(isect, writer)
        big_end = lane_broadcast(end, writer)
        row0 = row_load(rows, big_g, 0)
        row1 = row_load(rows, big_g, 1)
        half_size = ellipse_half_size(row0[2], row0[3], row1[0], row1[1] - LOG2_ALPHA_MIN)
        span_y = tile_rows(row0, half_size, tiles_y)
        y_base = span_y[0]
        while y_base < span_y[1]:
            span_x = wp.vec2i(0, 0)
            if y_base + lane < span_y[1]:
                span_x = tile_columns(row0, row1, half_size, y_base + lane, tiles_x)
            length = wp.max(span_x[1] - span_x[0], 0)
            before = lane_sum_before(length, lane)
            for k in range(wp.min(lane_count(), span_y[1] - y_base)):
                row_length = lane_broadcast(length, k)
                row_begin = lane_broadcast(span_x[0], k)
                row_isect = big_isect + lane_broadcast(before, k)
                for x in range(lane, row_length, lane_count()):
                    if row_isect + x < big_end:
                        tile_from_isect[row_isect + x] = (y_base + k) * tiles_x + row_begin + x
                        gaussian_from_isect[row_isect + x] = big_gaussian
            big_isect += lane_broadcast(before + length, lane_count() - 1)
            y_base += lane_count()
        for k in range(big_isect + lane, big_end, lane_count()):
            tile_from_isect[k] = tiles_x * tiles_y
            gaussian_from_isect[k] = big_gaussian


@wp.kernel(enable_backward=False)
def tile_ranges(
    first: int,
    gaussian_from_rank: wp.array[int],
    scan_words: wp.array[wp.int64],
    is_dynamic: wp.array[wp.uint8],
    num_gaussians: int,
    num_tiles: int,
    capacity: int,
    tile_from_isect: wp.array[int],
    gaussian_from_isect: wp.array[int],
    ranges: wp.array2d[int],
):
    """Launched with ``max(capacity, num_tiles) + 1`` threads over the sorted intersections."""
    thread = first + wp.tid()
    if stored_sum(scan_words) > wp.int64(capacity):
        if thread < num_gaussians:
            gaussian_from_isect[thread] = make_isect(gaussian_from_rank[thread], is_dynamic)
        if thread < num_tiles:
            ranges[thread, 0] = 0
            ranges[thread, 1] = num_gaussians
        return
    if thread > capacity:
        return
    before = int(-1)
    here = num_tiles
    if thread > 0:
        before = tile_from_isect[thread - 1]
    if thread < capacity:
        here = tile_from_isect[thread]
    # A tile's range begins where the tile index first reaches it; for an empty tile, that is where the next one begins.
    for tile in range(before, here):
        if tile >= 0:
            ranges[tile, 1] = thread
        if tile + 1 < num_tiles:
            ranges[tile + 1, 0] = thread


@wp.kernel(enable_backward=False)
def split_tiles(
    first: int,
    ranges: wp.array2d[int],
    half: int,
    gaussian_from_isect: wp.array[int],
    lengths: wp.array2d[int],
):
    """Splits each tile's list by branch, ``lane_count()`` threads for each tile.

    The second half of ``gaussian_from_isect`` begins at ``half`` and has the same ranges as the first. The static
    Gaussians of a tile are stored from the begin of its range upwards, the dynamic ones from its end downwards, both
    front to back. ``lengths`` is the number of each.
    """
    thread = first + wp.tid()
    lane = thread % lane_count()
    tile = thread / lane_count()
    begin = ranges[tile, 0]
    end = ranges[tile, 1]
    num_static = int(0)
    num_dynamic = int(0)
    base = begin + lane
    while base - lane < end:
        isects = Batch(-1)
        for k in range(BATCH_SIZE):
            if base + k * lane_count() < end:
                isects[k] = gaussian_from_isect[base + k * lane_count()]
        for k in range(BATCH_SIZE):
            g = isects[k] & ~DYNAMIC
            is_static = isects[k] == g
            is_dynamic = isects[k] >= 0 and not is_static
            static_ballot = lane_ballot(int(is_static))
            dynamic_ballot = lane_ballot(int(is_dynamic))
            if is_static:
                gaussian_from_isect[half + begin + num_static + lane_rank(static_ballot, lane)] = g
            if is_dynamic:
                gaussian_from_isect[half + end - 1 - num_dynamic - lane_rank(dynamic_ballot, lane)] = g
            num_static += lane_bit_count(static_ballot)
            num_dynamic += lane_bit_count(dynamic_ballot)
        base += BATCH_SIZE * lane_count()
    if lane == 0:
        lengths[tile, 0] = num_static
        lengths[tile, 1] = num_dynamic
