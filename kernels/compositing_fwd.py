"""Alpha compositing, front to back (paper Eq. 4).

Pixel p sees the Gaussians of its tile in depth order; with d = mean2d - p,

    alpha_i = min(ALPHA_MAX, opacity_i exp(-½ dᵀ conic_i d)),  skipped below ALPHA_MIN,
    T_0 = 1,  T_{i+1} = T_i (1 - alpha_i),  stopped before T would fall to TRANSMITTANCE_MIN,
    image = Σ_i alpha_i T_i feature_i + T_end background.

Depth, the channel after the image's, has no background and is normalised: divided by max(alpha, SMALLEST_ALPHA).

Three images (0 joint, 1 static Gaussians only, 2 dynamic Gaussians only) come out of one walk, each with its own
transmittance. A tile whose Gaussians all belong to one branch needs no walk for it: that branch's image is the joint
one and the other is background. So there are two kernels: ``images`` = 1 walks for the joint image, alone or in tiles
of one branch, and ``images`` = 3 walks the tiles that hold both.

A transmittance is kept negative once its pixel is done.
"""

import functools

import warp as wp

from .blocks import block_box, block_corner, module_options, stage_survivors, state_types
from .constants import ALPHA_MAX, LOG2_ALPHA_MIN, SMALLEST_ALPHA, TRANSMITTANCE_MIN
from .ellipse import ellipse_half_size, ellipse_span, ellipse_value
from .lanes import (
    exp2,
    lane_any,
    lane_bit_count,
    lane_columns,
    lane_count,
    lane_rows,
    lane_sum,
    lane_sync,
    span_begin,
    span_end,
    stage_address,
    stage_get,
)
from .rows import GEOMETRY_PARTS, row_load


@functools.cache
def make_composite_fwd(
    num_features: int, with_depth: bool, images: int, outputs: int, pixels: tuple[int, int], statistics: bool
) -> wp.Kernel:
    """Forward kernel, ``lane_count()`` threads for each block of pixels.

    Args:
        num_features: Channels of an image, at least 1.
        with_depth: Whether Gaussians have their depth as one more channel.
        images: How many it walks for, 1 or 3, see above.
        outputs: How many it writes, 1 or 3, at least ``images``; ``tile_ends`` is only read for 3.
        pixels: Columns and rows of pixels that a lane owns.
        statistics: Whether ``contributed`` and ``weights`` are written; they speak of the joint image.

    The kernel's ``background`` has ``num_features`` values, those of the next image ``background_stride`` further on.
    """
    C = num_features + int(with_depth)
    columns, rows_per_lane = pixels
    P = columns * rows_per_lane
    scalars, integers, colors, features_vector = state_types(C, images * P)

    @wp.kernel(enable_backward=False, module="unique", module_options=module_options(P))
    def composite_fwd(
        first: int,
        tile_ranges: wp.array[wp.vec2i],
        tile_ends: wp.array[wp.vec2i],
        gaussian_from_isect: wp.array[int],
        rows: wp.array2d[wp.vec4],
        is_dynamic: wp.array[wp.uint8],
        background: wp.array[float],
        background_stride: int,
        width: int,
        height: int,
        image: wp.array2d[float],
        depth: wp.array[float],
        alpha_image: wp.array[float],
        transmittance: wp.array[float],
        last: wp.array[int],
        contributed: wp.array[wp.uint8],
        weights: wp.array[float],
    ):
        thread = first + wp.tid()
        lane = thread % lane_count()
        block_width = lane_columns() * wp.static(columns)
        block_height = lane_rows() * wp.static(rows_per_lane)
        corner = block_corner(thread / lane_count(), width, block_width, block_height)
        if corner[1] >= width or corner[2] >= height:
            return  # a block of an edge tile that lies outside the image; its whole lane group leaves
        begin = tile_ranges[corner[0]][0]
        end = tile_ranges[corner[0]][1]
        ends = wp.vec2i(end, begin)
        if wp.static(outputs == 3):
            ends = tile_ends[corner[0]]
            if (ends[0] > begin and ends[1] > begin) != wp.static(images == 3):
                return  # the other kernel's tile
        box = block_box(corner, block_width, block_height, width, height)
        pixel_x = corner[1] + lane % lane_columns()
        pixel_y = corner[2] + lane / lane_columns()
        x0 = float(pixel_x) + 0.5
        y0 = float(pixel_y) + 0.5

        T = scalars()
        n = integers()
        color = colors()
        open_pixels = wp.vec3i(0, 0, 0)  # of this lane, in each image
        for j in range(wp.static(rows_per_lane)):
            for i in range(wp.static(columns)):
                if pixel_x + i * lane_columns() < width and pixel_y + j * lane_rows() < height:
                    for m in range(wp.static(images)):
                        T[m * wp.static(P) + j * wp.static(columns) + i] = 1.0
                    open_pixels += wp.vec3i(1, 1, 1)

        stage = stage_address()
        base = begin
        while base < end:
            # The joint image is done when one branch's is, so with three images the branches decide.
            walk_static = lane_any(open_pixels[wp.static(0 if images == 1 else 1)])
            walk_dynamic = int(0)
            if wp.static(images == 3):
                walk_static = walk_static * int(base < ends[0])
                walk_dynamic = lane_any(open_pixels[2]) * int(base < ends[1])
            if walk_static + walk_dynamic == 0:
                break
            isect = base + lane
            own_g = int(-1)
            tag = isect + 1 - begin
            if isect < end:
                own_g = gaussian_from_isect[isect]
                if wp.static(images == 3):
                    branch = int(is_dynamic[own_g])
                    tag = 2 * tag + branch
                    if wp.where(branch == 0, walk_static, walk_dynamic) == 0:
                        own_g = -1
            ballot, own0, own1, own2 = stage_survivors(own_g, tag, box, rows, lane, stage)
            for slot in range(lane_bit_count(ballot)):
                row0 = stage_get(stage, slot, 0, own0)
                row1 = stage_get(stage, slot, 1, own1)
                quad = stage_get(stage, slot, 2, own2)
                g = wp.cast(row1[2], wp.int32)
                position = wp.cast(row1[3], wp.int32)
                branch_image = int(-1)
                if wp.static(images == 3):
                    branch_image = 1 + (position & 1)
                    position = position >> 1
                features = features_vector()
                for c in range(wp.static(min(C, 4))):
                    features[c] = quad[c]
                for c in range(4, wp.static(C)):
                    features[c] = row_load(rows, g, GEOMETRY_PARTS + c / 4)[c % 4]
                threshold = row1[1] - LOG2_ALPHA_MIN
                half_size = ellipse_half_size(row0[2], row0[3], row1[0], threshold)
                weight = float(0.0)
                for j in range(
                    span_begin(row0[1] - half_size[1] - y0, wp.static(rows_per_lane)),
                    span_end(row0[1] + half_size[1] - y0, wp.static(rows_per_lane)),
                ):
                    dy = row0[1] - (y0 + float(j * lane_rows()))
                    span = ellipse_span(row0[2], row0[3], row1[0], threshold, dy)
                    for i in range(
                        span_begin(row0[0] - span[1] - x0, wp.static(columns)),
                        span_end(row0[0] - span[0] - x0, wp.static(columns)),
                    ):
                        dx = row0[0] - (x0 + float(i * lane_columns()))
                        log2_alpha = row1[1] - ellipse_value(row0[2], row0[3], row1[0], dx, dy)
                        if log2_alpha >= LOG2_ALPHA_MIN:
                            alpha = wp.min(ALPHA_MAX, exp2(log2_alpha))
                            for m in range(wp.static(images)):
                                if m == 0 or m == branch_image:
                                    k = m * wp.static(P) + j * wp.static(columns) + i
                                    t = T[k]
                                    if t > 0.0:
                                        t_next = t - alpha * t
                                        if t_next <= TRANSMITTANCE_MIN:
                                            T[k] = -t
                                            open_pixels[m] -= 1
                                        else:
                                            w = alpha * t
                                            for c in range(wp.static(C)):
                                                color[k * wp.static(C) + c] += w * features[c]
                                            T[k] = t_next
                                            n[k] = position
                                            if m == 0:
                                                weight += w
                if wp.static(statistics):
                    weight = lane_sum(weight)
                    if lane == 0 and weight > 0.0:
                        contributed[g] = wp.uint8(1)
                        wp.atomic_add(weights, g, weight)
            lane_sync()
            base += lane_count()

        for j in range(wp.static(rows_per_lane)):
            for i in range(wp.static(columns)):
                x = pixel_x + i * lane_columns()
                y = pixel_y + j * lane_rows()
                if x < width and y < height:
                    for m in range(wp.static(outputs)):
                        k = wp.static(P * (images // 3)) * m + j * wp.static(columns) + i
                        kept = float(1.0)  # 0 for the image of a branch that this tile holds nothing of
                        if wp.static(outputs > images) and m > 0:
                            if ends[m - 1] == begin:
                                kept = 0.0
                        p = (m * height + y) * width + x
                        t = 1.0 - kept + kept * wp.abs(T[k])
                        alpha_image[p] = 1.0 - t
                        transmittance[p] = t
                        last[p] = n[k] * int(kept)
                        for c in range(wp.static(num_features)):
                            value = kept * color[k * wp.static(C) + c]
                            if background.shape[0] > 0:
                                value += t * background[m * background_stride + c]
                            image[p, c] = value
                        if wp.static(num_features < C):
                            drawn = kept * color[k * wp.static(C) + wp.static(num_features)]
                            depth[p] = drawn / wp.max(1.0 - t, SMALLEST_ALPHA)

    return composite_fwd
