"""Blocks of pixels: which pixels a lane group composites, and how it fetches the Gaussians that matter to them.

A lane group owns a block; each lane owns ``pixels`` (columns, rows) of it, a lane layout's width or height apart. The
lanes fetch one Gaussian each, test it against the block and put the survivors on the stage, in order; then all lanes
composite the survivors one by one. On CPU the one lane owns the whole block and has no stage.
"""

import functools

import warp as wp

from .constants import LOG2_ALPHA_MIN, TILE_SIZE
from .ellipse import ellipse_meets_box
from .lanes import lane_ballot, lane_rank, lane_sync, stage_put
from .rows import GEOMETRY_PARTS, row_load

Counter = wp.types.vector(length=1, dtype=int)
"""A number that an inner loop counts with: Warp carries a plain one from iteration to iteration by copies."""


@functools.cache
def state_types(num_channels: int, num_pixels: int) -> tuple[type, type, type, type]:
    """Vector types of what a lane holds: a float, an int and a colour for each of its pixels, and one Gaussian's
    features."""
    return (
        wp.types.vector(length=num_pixels, dtype=float),
        wp.types.vector(length=num_pixels, dtype=int),
        wp.types.vector(length=num_pixels * num_channels, dtype=float),
        wp.types.vector(length=num_channels, dtype=float),
    )


def module_options(pixels_per_lane: int) -> dict[str, object]:
    """Compile options of a compositing kernel: a lane's few pixels on CUDA are unrolled into registers, the CPU lane's
    whole tile is looped over. (Warp's own level is 3 on CUDA and 2 on CPU.)"""
    return {"fast_math": True, "optimization_level": 3, "max_unroll": 16 if pixels_per_lane <= 8 else 4}


@wp.func
def blocks_of_tile(block_width: int, block_height: int) -> int:
    """How many blocks a tile is cut into."""
    return (TILE_SIZE / block_width) * (TILE_SIZE / block_height)


@wp.func
def block_corner(block: int, width: int, block_width: int, block_height: int) -> wp.vec3i:
    """Tile index, left and top [px] of an image's block; the blocks of a tile follow each other."""
    tile = block / blocks_of_tile(block_width, block_height)
    block_of_tile = block % blocks_of_tile(block_width, block_height)
    blocks_x = TILE_SIZE / block_width
    tiles_x = (width + TILE_SIZE - 1) / TILE_SIZE
    left = (tile % tiles_x) * TILE_SIZE + (block_of_tile % blocks_x) * block_width
    top = (tile / tiles_x) * TILE_SIZE + (block_of_tile / blocks_x) * block_height
    return wp.vec3i(tile, left, top)


@wp.func
def is_joint(image: int, looked: int) -> bool:
    """Whether a branch's image of a block is the joint image, bit for bit.

    It is where the joint image, before all of its pixels were opaque, looked at that branch's Gaussians alone.

    Args:
        image: 1 static, 2 dynamic.
        looked: Bit m is set where the joint image looked at a Gaussian of image m, bit 0 once it is finished.
    """
    return looked == 1 or looked == 1 + (1 << image)


@wp.func
def tile_list(
    image: int, tile: int, tile_ranges: wp.array[wp.vec2i], branch_lengths: wp.array[wp.vec2i], half: int
) -> wp.vec3i:
    """A tile's list of Gaussians in one image: where it begins, which way it runs, and its length (``split_tiles``)."""
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
    """Puts the lane group's Gaussians that reach into the block on the stage, each with its index and a tag.

    Args:
        g: This lane's Gaussian, or -1 for none.
        tag: A number that goes with it.

    Returns:
        The ballot of survivors and, for the CPU's single lane, its own three parts: [x, y, a, b],
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
