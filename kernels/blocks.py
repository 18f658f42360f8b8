"""Blocks of pixels: which pixels a lane group composites, and how it fetches the Gaussians that reach into them.

A lane group owns a block; each lane owns ``pixels`` (columns, rows) of it, spaced by the width and the height of the
lane layout. The lanes fetch one Gaussian each, test it against the block and put the survivors into the staging buffer,
in order; then all lanes composite the survivors one by one. On CPU the single lane owns the whole block and needs no
staging buffer.
"""

import functools

import warp as wp

from .constants import LOG2_ALPHA_MIN, TILE_SIZE
from .ellipse import ellipse_meets_box
from .lanes import lane_ballot, lane_rank, lane_sync, stage_put
from .rows import GEOMETRY_PARTS, row_load

Counter = wp.types.vector(length=1, dtype=int)
"""An int that an inner loop modifies: Warp would carry a plain int from iteration to iteration by copies."""


@functools.cache
def state_types(num_channels: int, num_pixels: int) -> tuple[type, type, type, type]:
    """Vector types of a lane's state: a float, an int and a colour per pixel, and the features of one Gaussian."""
    return (
        wp.types.vector(length=num_pixels, dtype=float),
        wp.types.vector(length=num_pixels, dtype=int),
        wp.types.vector(length=num_pixels * num_channels, dtype=float),
        wp.types.vector(length=num_channels, dtype=float),
    )


def is_vectorized(pixels: tuple[int, int]) -> bool:
    """Whether a lane that owns these columns and rows of pixels composites a row of them at once, without branches.

    LLVM makes vector instructions of such a loop. So it does on CPU, where a lane owns a whole tile; on CUDA the lanes
    themselves are the vector.
    """
    return pixels[0] == TILE_SIZE


def module_options(pixels_per_lane: int) -> dict[str, object]:
    """Compile options of a compositing kernel.

    On CUDA, loops over a lane's few pixels are unrolled into registers; on CPU, where a lane owns a whole tile, they
    are not. (Warp's default optimization level is 3 on CUDA and 2 on CPU.)
    """
    return {"fast_math": True, "optimization_level": 3, "max_unroll": 16 if pixels_per_lane <= 8 else 4}


@wp.func
def blocks_of_tile(block_width: int, block_height: int) -> int:
    """Number of blocks in a tile."""
    return (TILE_SIZE / block_width) * (TILE_SIZE / block_height)


@wp.func
def block_corner(block: int, width: int, block_width: int, block_height: int) -> wp.vec3i:
    """Tile index, left and top [px] of a block of an image; the blocks of a tile are consecutive."""
    tile = block / blocks_of_tile(block_width, block_height)
    block_of_tile = block % blocks_of_tile(block_width, block_height)
    blocks_x = TILE_SIZE / block_width
    tiles_x = (width + TILE_SIZE - 1) / TILE_SIZE
    left = (tile % tiles_x) * TILE_SIZE + (block_of_tile % blocks_x) * block_width
    top = (tile / tiles_x) * TILE_SIZE + (block_of_tile / blocks_x) * block_height
    return wp.vec3i(tile, left, top)


@wp.func
def equals_joint(image: int, joint_state: int) -> bool:
    """Whether a branch's image of a block equals the joint image, bit for bit.

    This holds if the joint image evaluated Gaussians of that branch only, before all of its pixels were opaque.

    Args:
        image: 1 static, 2 dynamic.
        joint_state: Bit m is set if the joint image evaluated a Gaussian of image m, bit 0 once it is complete.
    """
    return joint_state == 1 or joint_state == 1 + (1 << image)


@wp.func
def tile_list(
    image: int, tile: int, tile_ranges: wp.array[wp.vec2i], branch_lengths: wp.array[wp.vec2i], half: int
) -> wp.vec3i:
    """Begin, direction (1 or -1) and length of a tile's list of Gaussians in one image; see ``split_tiles``."""
    tile_range = tile_ranges[tile]
    lengths = wp.vec2i(0, 0)
    if image > 0:
        lengths = branch_lengths[tile]
    if image == 1:
        return wp.vec3i(half + tile_range[0], 1, lengths[0])
    if image == 2:
        return wp.vec3i(half + tile_range[1] - 1, -1, lengths[1])
    return wp.vec3i(tile_range[0], 1, tile_range[1] - tile_range[0])


@wp.func
def block_box(corner: wp.vec3i, block_width: int, block_height: int, width: int, height: int) -> wp.vec4:
    """Left, top, right, bottom of the outermost pixel centres of a block inside the image."""
    return wp.vec4(
        float(corner[1]) + 0.5,
        float(corner[2]) + 0.5,
        float(wp.min(corner[1] + block_width, width)) - 0.5,
        float(wp.min(corner[2] + block_height, height)) - 0.5,
    )


@wp.func
def stage_survivors(g: int, tag: int, box: wp.vec4, rows: wp.array2d[wp.vec4], lane: int, stage: wp.uint64):
    """Puts those Gaussians of the lane group that reach into the block into the staging buffer, with index and tag.

    Args:
        g: This lane's Gaussian, or -1 for none.
        tag: An int to store with it.
        box: From ``block_box``.
        stage: From ``stage_address``.

    Returns:
        The ballot of survivors and, for the single lane of the CPU, its own three parts: [x, y, a, b],
        [c, log2 opacity, g, tag] (the last two as bits), [feature 0..3].
    """
    own0 = wp.vec4(0.0)
    own1 = wp.vec4(0.0)
    own2 = wp.vec4(0.0)
    hit = int(0)
    if g >= 0:
        own0 = row_load(rows, g, 0)
        own1 = row_load(rows, g, 1)
        if ellipse_meets_box(
            own0[2],
            own0[3],
            own1[0],
            own1[1] - LOG2_ALPHA_MIN,
            box[0] - own0[0],
            box[1] - own0[1],
            box[2] - own0[0],
            box[3] - own0[1],
        ):
            hit = 1
            own1[2] = wp.cast(g, wp.float32)
            own1[3] = wp.cast(tag, wp.float32)
            own2 = row_load(rows, g, GEOMETRY_PARTS)
    ballot = lane_ballot(hit)
    if hit != 0:
        slot = lane_rank(ballot, lane)
        stage_put(stage, slot, 0, own0)
        stage_put(stage, slot, 1, own1)
        stage_put(stage, slot, 2, own2)
    lane_sync()
    return ballot, own0, own1, own2
