"""Alpha compositing, front to back, and its reverse walk.

Forward (paper Eq. 4). Pixel p sees the Gaussians of its tile in depth order; with d = mean2d - p,

    alpha_i = min(ALPHA_MAX, opacity_i exp(-½ dᵀ conic_i d)),  skipped below ALPHA_MIN,
    T_0 = 1,  T_{i+1} = T_i (1 - alpha_i),  stopped before T would fall to TRANSMITTANCE_MIN,
    image = Σ_i alpha_i T_i feature_i + T_end background.

Backward. With the cotangent g of the image and h of T_end, and R_i = Σ_{j>i} alpha_j T_j (feature_j · g) + T_end
(background · g + h) gathered while walking back to front,

    v_feature_i = Σ_p alpha_i T_i g,      v_alpha_i = T_i (feature_i · g) - R_i / (1 - alpha_i),

and v_alpha_i reaches the Gaussian's six geometric numbers through the moments of s = alpha_i v_alpha_i over its
pixels: Σ s, Σ s dx, Σ s dy, Σ s dx², Σ s dx dy, Σ s dy². ``unpack`` turns moments into gradients once per Gaussian.

with d = mean2d - p. ``rows`` describes a Gaussian's row in memory and turns the moments into gradients.

Each lane group owns a block of pixels and each lane ``pixels`` (columns, rows) of them, a lane layout's width or
height apart. The lanes fetch one Gaussian each, test it against the block, put the survivors on the stage, and then
all lanes composite them one by one. On CPU the one lane owns the whole tile and walks only the pixels that the
Gaussian covers.

With ``images`` = 3 one walk makes three images: 0 joint, 1 static Gaussians only, 2 dynamic Gaussians only; each has
its own transmittance. A transmittance is stored negative once its pixel is done.
"""

import functools

import warp as wp

from .constants import ALPHA_MAX, LN_2, LOG2_ALPHA_MIN, TILE_SIZE, TRANSMITTANCE_MIN
from .ellipse import ellipse_half_size, ellipse_meets_box, ellipse_span, ellipse_value
from .lanes import (
    exp2,
    lane_any,
    lane_ballot,
    lane_bit_count,
    lane_columns,
    lane_count,
    lane_max,
    lane_rank,
    lane_rows,
    lane_sum,
    lane_sync,
    make_lane_add,
    span_begin,
    span_end,
    stage_address,
    stage_get,
    stage_put,
)
from .rows import GEOMETRY_PARTS, NUM_ABSOLUTE, NUM_MOMENTS, row_load


@wp.func
def block_corner(group: int, width: int, block_width: int, block_height: int) -> wp.vec3i:
    """Tile index and left, top [px] of the block of pixels that a lane group owns."""
    blocks_x = TILE_SIZE / block_width
    blocks = blocks_x * (TILE_SIZE / block_height)
    tile = group / blocks
    block = group % blocks
    tiles_x = (width + TILE_SIZE - 1) / TILE_SIZE
    left = (tile % tiles_x) * TILE_SIZE + (block % blocks_x) * block_width
    top = (tile / tiles_x) * TILE_SIZE + (block / blocks_x) * block_height
    return wp.vec3i(tile, left, top)


@wp.func
def meets_block(row0: wp.vec4, row1: wp.vec4, left: float, top: float, right: float, bottom: float) -> bool:
    """Whether a Gaussian reaches ALPHA_MIN somewhere between the outermost pixel centres of a block."""
    return ellipse_meets_box(
        row0[2],
        row0[3],
        row1[0],
        row1[1] - LOG2_ALPHA_MIN,
        left - row0[0],
        top - row0[1],
        right - row0[0],
        bottom - row0[1],
    )


@functools.cache
def make_composite_fwd(num_channels: int, images: int, pixels: tuple[int, int], statistics: bool) -> wp.Kernel:
    """Forward kernel, ``lane_count()`` threads for each block of pixels.

    Args:
        num_channels: Features of a Gaussian, at least 1.
        images: 1 (joint) or 3 (joint, static only, dynamic only).
        pixels: Columns and rows of pixels that a lane owns.
        statistics: Whether ``contributed`` and ``weights`` are written; they speak of the joint image.
    """
    C = num_channels
    columns, rows_per_lane = pixels
    P = columns * rows_per_lane
    state = wp.types.vector(length=images * P, dtype=float)
    state_int = wp.types.vector(length=images * P, dtype=int)
    color_state = wp.types.vector(length=images * P * C, dtype=float)
    feature_vector = wp.types.vector(length=C, dtype=float)

    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True})
    def composite_fwd(
        first: int,
        tile_ranges: wp.array[wp.vec2i],
        tile_ends: wp.array[wp.vec2i],
        gaussian_from_isect: wp.array[int],
        rows: wp.array2d[wp.vec4],
        is_dynamic: wp.array[wp.uint8],
        background: wp.array[float],
        width: int,
        height: int,
        image: wp.array2d[float],
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
        tile = corner[0]
        if corner[1] >= width or corner[2] >= height:
            return  # a block of an edge tile that lies outside the image; its whole lane group leaves
        box_left = float(corner[1]) + 0.5
        box_top = float(corner[2]) + 0.5
        box_right = float(wp.min(corner[1] + block_width, width)) - 0.5
        box_bottom = float(wp.min(corner[2] + block_height, height)) - 0.5
        pixel_x = corner[1] + lane % lane_columns()
        pixel_y = corner[2] + lane / lane_columns()
        x0 = float(pixel_x) + 0.5
        y0 = float(pixel_y) + 0.5

        T = state()
        n = state_int()
        color = color_state()
        remaining = wp.vec2i(0, 0)  # open pixels of the static and of the dynamic image; unless mixed, of the joint one
        for j in range(wp.static(rows_per_lane)):
            for i in range(wp.static(columns)):
                if pixel_x + i * lane_columns() < width and pixel_y + j * lane_rows() < height:
                    for m in range(wp.static(images)):
                        T[m * wp.static(P) + j * wp.static(columns) + i] = 1.0
                    remaining += wp.vec2i(1, 1)

        begin = tile_ranges[tile][0]
        end = tile_ranges[tile][1]
        ends = wp.vec2i(end, begin)  # where the last Gaussian of each branch lies
        mixed = int(0)  # with one branch only, its image is the joint one and needs no walk of its own
        if wp.static(images == 3):
            ends = tile_ends[tile]
            mixed = int(ends[0] > begin and ends[1] > begin)
        stage = stage_address()
        base = begin
        while base < end:
            open_static = lane_any(remaining[0]) != 0 and base < ends[0]
            open_dynamic = lane_any(remaining[1]) != 0 and base < ends[1]
            if not (open_static or open_dynamic):
                break
            isect = base + lane
            own0 = wp.vec4(0.0)
            own1 = wp.vec4(0.0)
            own2 = wp.vec4(0.0)
            hit = int(0)
            if isect < end:
                own_g = gaussian_from_isect[isect]
                branch = int(0)
                wanted = open_static
                if wp.static(images == 3):
                    branch = int(is_dynamic[own_g])
                    if branch != 0:
                        wanted = open_dynamic
                if wanted:
                    own0 = row_load(rows, own_g, 0)
                    own1 = row_load(rows, own_g, 1)
                    if meets_block(own0, own1, box_left, box_top, box_right, box_bottom):
                        hit = 1
                        own1[2] = wp.cast(own_g, wp.float32)
                        own1[3] = wp.cast(2 * (isect + 1 - begin) + branch, wp.float32)
                        own2 = row_load(rows, own_g, wp.static(GEOMETRY_PARTS))
            ballot = lane_ballot(hit)
            if hit != 0:
                slot = lane_rank(ballot, lane)
                stage_put(stage, slot, 0, own0)
                stage_put(stage, slot, 1, own1)
                stage_put(stage, slot, 2, own2)
            lane_sync()
            for slot in range(lane_bit_count(ballot)):
                row0 = stage_get(stage, slot, 0, own0)
                row1 = stage_get(stage, slot, 1, own1)
                quad = stage_get(stage, slot, 2, own2)
                g = wp.cast(row1[2], wp.int32)
                position = wp.cast(row1[3], wp.int32) >> 1
                selected = int(-1)  # the branch image that this Gaussian goes into, besides the joint one
                if mixed != 0:
                    selected = 1 + (wp.cast(row1[3], wp.int32) & 1)
                features = feature_vector()
                for c in range(wp.static(min(C, 4))):
                    features[c] = quad[c]
                for c in range(4, wp.static(C)):
                    features[c] = row_load(rows, g, wp.static(GEOMETRY_PARTS) + c / 4)[c % 4]
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
                                if m == 0 or m == selected:
                                    k = m * wp.static(P) + j * wp.static(columns) + i
                                    t = T[k]
                                    if t > 0.0:
                                        t_next = t - alpha * t
                                        if t_next <= TRANSMITTANCE_MIN:
                                            T[k] = -t
                                            if m == 0 and mixed == 0:
                                                remaining -= wp.vec2i(1, 1)
                                            elif m == 1:
                                                remaining[0] -= 1
                                            elif m == 2:
                                                remaining[1] -= 1
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

        if wp.static(images == 3):
            for m in range(2):
                if mixed == 0 and ends[m] > begin:
                    for k in range(wp.static(P)):
                        T[(m + 1) * wp.static(P) + k] = T[k]
                        n[(m + 1) * wp.static(P) + k] = n[k]
                    for k in range(wp.static(P * C)):
                        color[(m + 1) * wp.static(P * C) + k] = color[k]
        for m in range(wp.static(images)):
            for j in range(wp.static(rows_per_lane)):
                for i in range(wp.static(columns)):
                    x = pixel_x + i * lane_columns()
                    y = pixel_y + j * lane_rows()
                    if x < width and y < height:
                        p = (m * height + y) * width + x
                        k = m * wp.static(P) + j * wp.static(columns) + i
                        t = wp.abs(T[k])
                        alpha_image[p] = 1.0 - t
                        transmittance[p] = t
                        last[p] = n[k]
                        for c in range(wp.static(C)):
                            value = color[k * wp.static(C) + c]
                            if background.shape[0] > 0:
                                value += t * background[c]
                            image[p, c] = value

    return composite_fwd


@functools.cache
def make_composite_bwd(num_channels: int, images: int, pixels: tuple[int, int], absolute: bool) -> wp.Kernel:
    """Reverse walk, launched like the forward kernel.

    Args:
        num_channels, images, pixels: As in ``make_composite_fwd``; ``pixels`` may differ from the forward kernel's.
        absolute: Whether the absolute-value variant of the means' gradient is gathered too.

    The kernel adds to ``gradients`` [N, gradient_stride], which starts at zero.
    """
    C = num_channels
    columns, rows_per_lane = pixels
    P = columns * rows_per_lane
    state = wp.types.vector(length=images * P, dtype=float)
    state_int = wp.types.vector(length=images * P, dtype=int)
    color_state = wp.types.vector(length=images * P * C, dtype=float)
    feature_vector = wp.types.vector(length=C, dtype=float)
    num_sums = C + NUM_MOMENTS + (NUM_ABSOLUTE if absolute else 0)
    sums_vector, lane_add = make_lane_add(num_sums)

    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True})
    def composite_bwd(
        first: int,
        tile_ranges: wp.array[wp.vec2i],
        tile_ends: wp.array[wp.vec2i],
        gaussian_from_isect: wp.array[int],
        rows: wp.array2d[wp.vec4],
        is_dynamic: wp.array[wp.uint8],
        background: wp.array[float],
        width: int,
        height: int,
        transmittance: wp.array[float],
        last: wp.array[int],
        v_image: wp.array2d[float],
        v_alpha_image: wp.array[float],
        gradients: wp.array2d[float],
    ):
        thread = first + wp.tid()
        lane = thread % lane_count()
        block_width = lane_columns() * wp.static(columns)
        block_height = lane_rows() * wp.static(rows_per_lane)
        corner = block_corner(thread / lane_count(), width, block_width, block_height)
        if corner[1] >= width or corner[2] >= height:
            return  # a block of an edge tile that lies outside the image; its whole lane group leaves
        box_left = float(corner[1]) + 0.5
        box_top = float(corner[2]) + 0.5
        box_right = float(wp.min(corner[1] + block_width, width)) - 0.5
        box_bottom = float(wp.min(corner[2] + block_height, height)) - 0.5
        pixel_x = corner[1] + lane % lane_columns()
        pixel_y = corner[2] + lane / lane_columns()
        x0 = float(pixel_x) + 0.5
        y0 = float(pixel_y) + 0.5

        T = state()
        R = state()
        n = state_int()
        v_color = color_state()
        n_max = int(0)
        for m in range(wp.static(images)):
            for j in range(wp.static(rows_per_lane)):
                for i in range(wp.static(columns)):
                    x = pixel_x + i * lane_columns()
                    y = pixel_y + j * lane_rows()
                    if x < width and y < height:
                        p = (m * height + y) * width + x
                        k = m * wp.static(P) + j * wp.static(columns) + i
                        T[k] = transmittance[p]
                        n[k] = last[p]
                        n_max = wp.max(n_max, n[k])
                        behind = float(0.0)
                        if v_alpha_image.shape[0] > 0:
                            behind = -v_alpha_image[p]
                        for c in range(wp.static(C)):
                            v = v_image[p, c]
                            v_color[k * wp.static(C) + c] = v
                            if background.shape[0] > 0:
                                behind += background[c] * v
                        R[k] = T[k] * behind
        n_max = lane_max(n_max)

        begin = tile_ranges[corner[0]][0]
        mixed = int(0)
        if wp.static(images == 3):
            ends = tile_ends[corner[0]]
            mixed = int(ends[0] > begin and ends[1] > begin)
            for m in range(2):
                if mixed == 0 and ends[m] > begin:
                    for k in range(wp.static(P)):
                        R[k] = R[k] + R[(m + 1) * wp.static(P) + k]
                    for k in range(wp.static(P * C)):
                        v_color[k] = v_color[k] + v_color[(m + 1) * wp.static(P * C) + k]
        stage = stage_address()
        base = (n_max - 1) / lane_count() * lane_count()
        while base >= 0 and n_max > 0:
            index = base + lane
            own0 = wp.vec4(0.0)
            own1 = wp.vec4(0.0)
            own2 = wp.vec4(0.0)
            hit = int(0)
            if index < n_max:
                own_g = gaussian_from_isect[begin + index]
                own0 = row_load(rows, own_g, 0)
                own1 = row_load(rows, own_g, 1)
                if meets_block(own0, own1, box_left, box_top, box_right, box_bottom):
                    hit = 1
                    branch = int(0)
                    if wp.static(images == 3):
                        branch = int(is_dynamic[own_g])
                    own1[2] = wp.cast(own_g, wp.float32)
                    own1[3] = wp.cast(2 * (index + 1) + branch, wp.float32)
                    own2 = row_load(rows, own_g, wp.static(GEOMETRY_PARTS))
            ballot = lane_ballot(hit)
            if hit != 0:
                slot = lane_rank(ballot, lane)
                stage_put(stage, slot, 0, own0)
                stage_put(stage, slot, 1, own1)
                stage_put(stage, slot, 2, own2)
            lane_sync()
            count = lane_bit_count(ballot)
            for back in range(count):
                slot = count - 1 - back
                row0 = stage_get(stage, slot, 0, own0)
                row1 = stage_get(stage, slot, 1, own1)
                quad = stage_get(stage, slot, 2, own2)
                g = wp.cast(row1[2], wp.int32)
                position = wp.cast(row1[3], wp.int32) >> 1
                selected = int(-1)
                if mixed != 0:
                    selected = 1 + (wp.cast(row1[3], wp.int32) & 1)
                features = feature_vector()
                for c in range(wp.static(min(C, 4))):
                    features[c] = quad[c]
                for c in range(4, wp.static(C)):
                    features[c] = row_load(rows, g, wp.static(GEOMETRY_PARTS) + c / 4)[c % 4]
                threshold = row1[1] - LOG2_ALPHA_MIN
                half_size = ellipse_half_size(row0[2], row0[3], row1[0], threshold)
                sums = sums_vector()
                touched = int(0)
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
                            unclamped = exp2(log2_alpha)
                            alpha = wp.min(ALPHA_MAX, unclamped)
                            scale = 1.0 / (1.0 - alpha)
                            v_alpha = float(0.0)
                            for m in range(wp.static(images)):
                                if m == 0 or m == selected:
                                    k = m * wp.static(P) + j * wp.static(columns) + i
                                    if position <= n[k]:
                                        touched = 1
                                        t = T[k] * scale
                                        w = alpha * t
                                        seen = float(0.0)
                                        for c in range(wp.static(C)):
                                            v = v_color[k * wp.static(C) + c]
                                            seen += features[c] * v
                                            sums[c] += w * v
                                        v_alpha += t * seen - R[k] * scale
                                        R[k] = R[k] + w * seen
                                        T[k] = t
                            if unclamped <= ALPHA_MAX:
                                v = alpha * v_alpha
                                sums[wp.static(C)] += v
                                sums[wp.static(C + 1)] += v * dx
                                sums[wp.static(C + 2)] += v * dy
                                sums[wp.static(C + 3)] += v * dx * dx
                                sums[wp.static(C + 4)] += v * dx * dy
                                sums[wp.static(C + 5)] += v * dy * dy
                                if wp.static(absolute):
                                    sums[wp.static(C + 6)] += LN_2 * wp.abs(v * (2.0 * row0[2] * dx + row0[3] * dy))
                                    sums[wp.static(C + 7)] += LN_2 * wp.abs(v * (row0[3] * dx + 2.0 * row1[0] * dy))
                if lane_any(touched) != 0:
                    lane_add(sums, gradients, g)
            lane_sync()
            base -= lane_count()

    return composite_bwd
