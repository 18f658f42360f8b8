"""Backward pass of alpha compositing (see ``compositing_fwd``), by a traversal in reverse order.

With the gradients g of the image and h of alpha, and R_i = Σ_{j>i} alpha_j T_j (feature_j · g) + T_end (background · g
- h) accumulated back to front,

    v_feature_i = Σ_p alpha_i T_i g,      v_alpha_i = T_i (feature_i · g) - R_i / (1 - alpha_i),

and the gradients of the Gaussian's six geometric values follow from the moments of s = alpha_i v_alpha_i over its
pixels: Σ s, Σ s dx, Σ s dy, Σ s dx², Σ s dx dy, Σ s dy². ``rows`` turns them into gradients, once per Gaussian.
T_i is recomputed from T_end by dividing by 1 - alpha_i, which max_alpha keeps away from zero.
"""

import functools

import warp as wp

from .blocks import (
    block_box,
    block_corner,
    blocks_of_tile,
    equals_joint,
    is_vectorized,
    module_options,
    stage_survivors,
    state_types,
    tile_list,
)
from .constants import LN_2, LOG2_ALPHA_MIN, MIN_ALPHA
from .ellipse import ellipse_half_size, ellipse_span, ellipse_value
from .lanes import (
    exp2,
    lane_any,
    lane_bit_count,
    lane_columns,
    lane_count,
    lane_max,
    lane_rows,
    lane_sync,
    make_lane_add,
    span_begin,
    span_end,
    stage_address,
    stage_get,
)
from .pixel_rows import make_read_gradient_row, make_read_row, read_gradient
from .rows import GEOMETRY_PARTS, NUM_ABSOLUTE_SUMS, NUM_MOMENTS, row_load
from .tiles import DYNAMIC


@functools.cache
def make_composite_bwd(
    num_features: int, with_depth: bool, images: int, pixels: tuple[int, int], absgrad: bool
) -> wp.Kernel:
    """Backward kernel, launched with as many threads as the forward kernel.

    Args:
        num_features, with_depth, images, pixels: As in ``make_composite_fwd``.
        absgrad: Whether the absolute values of each pixel's gradient of the means on screen are summed, too.

    The kernel adds to ``gradients`` [N, gradient_stride], which is initially zero. Each image has its own arrays of
    gradients; a missing array stands for zeros, and bit m of ``images_with_gradient`` is set if image m has any
    gradient.

    Depth is one more channel of the traversal, D = Σ_i alpha_i T_i depth_i. Wherever alpha is above MIN_ALPHA,

        depth = D / alpha,      v_D = v_depth / alpha,      v_alpha += -v_depth D / alpha².

    A pixel's gradient of a mean on screen is -s conic (dx, dy). Absolute values are those of the pixels of each image,
    so that they do not depend on which blocks of two images are equal.
    """
    C = num_features + int(with_depth)
    columns, rows_per_lane = pixels
    P = columns * rows_per_lane
    scalars, integers, colors, features_vector = state_types(C, P)
    vectorized = is_vectorized(pixels)
    num_sums = C + NUM_MOMENTS + (NUM_ABSOLUTE_SUMS if absgrad else 0)
    sums_vector, lane_add = make_lane_add(num_sums, columns if vectorized else 1)
    float_row, read_floats = make_read_row(columns)
    int_row, read_ints = make_read_row(columns, int)
    _, read_gradients = make_read_gradient_row(columns)
    _, read_color_gradients = make_read_gradient_row(columns * num_features)

    # No grid-stride loop of Warp; docs/design/lane-groups.md lists the kernels that are faster without it.
    @wp.kernel(enable_backward=False, grid_stride=False, module="unique", module_options=module_options(P))
    def composite_bwd(
        first: int,
        tile_ranges: wp.array[wp.vec2i],
        branch_lengths: wp.array[wp.vec2i],
        gaussian_from_isect: wp.array[int],
        half: int,
        rows: wp.array2d[wp.vec4],
        background: wp.array[float],
        background_stride: int,
        width: int,
        height: int,
        max_alpha: float,
        depth: wp.array[float],
        transmittance: wp.array[float],
        last: wp.array[int],
        joint_state: wp.array[int],
        v_image_joint: wp.array[float],
        v_image_static: wp.array[float],
        v_image_dynamic: wp.array[float],
        v_alpha_joint: wp.array[float],
        v_alpha_static: wp.array[float],
        v_alpha_dynamic: wp.array[float],
        v_depth_joint: wp.array[float],
        v_depth_static: wp.array[float],
        v_depth_dynamic: wp.array[float],
        images_with_gradient: int,
        gradients: wp.array2d[float],
    ):
        thread = first + wp.tid()
        lane = thread % lane_count()
        block_width = lane_columns() * wp.static(columns)
        block_height = lane_rows() * wp.static(rows_per_lane)
        # The images of a tile are consecutive, because they read and add to mostly the same memory.
        group = thread / lane_count()
        blocks = blocks_of_tile(block_width, block_height)
        own_image = group / blocks % wp.static(images)
        block = group / (blocks * wp.static(images)) * blocks + group % blocks
        corner = block_corner(block, width, block_width, block_height)
        if corner[1] >= width or corner[2] >= height:
            return  # this block of an edge tile is outside the image; its whole lane group returns
        list_image = own_image  # the image whose list is traversed
        image_bits = 1 << own_image  # the images whose gradients are propagated, as bits
        if wp.static(images > 1):
            for m in range(1, wp.static(images)):
                if equals_joint(m, joint_state[block]):
                    # One traversal serves both images, because their gradients add up; absolute values do not.
                    if wp.static(not absgrad):
                        if own_image == 0:
                            image_bits = image_bits | (1 << m)
                        if own_image == m:
                            return
                    elif own_image == m:
                        list_image = 0
        image_bits = image_bits & images_with_gradient
        if image_bits == 0:
            return
        isects = tile_list(list_image, corner[0], tile_ranges, branch_lengths, half)
        box = block_box(corner, block_width, block_height, width, height)
        pixel_x = corner[1] + lane % lane_columns()
        pixel_y = corner[2] + lane / lane_columns()
        x0 = float(pixel_x) + 0.5
        y0 = float(pixel_y) + 0.5

        T = scalars()
        R = scalars()
        n = integers()
        v_color = colors()
        n_max = int(0)
        if wp.static(vectorized):
            inside = wp.min(wp.static(columns), width - pixel_x)
            v_transmittances = float_row()
            for j in range(wp.min(wp.static(rows_per_lane), height - pixel_y)):
                row_begin = wp.static(columns) * j & wp.static(P - 1)
                begin = (pixel_y + j) * width + pixel_x
                t_row = read_floats(transmittance, list_image * height * width + begin, inside)
                last_row = read_ints(last, list_image * height * width + begin, inside)
                for i in range(wp.static(columns)):
                    T[row_begin + i] = t_row[i]
                    n[row_begin + i] = last_row[i]
                for m in range(own_image, wp.where(own_image == 0, wp.static(images), own_image + 1)):
                    if (image_bits & (1 << m)) != 0:
                        v_alphas = read_gradients(m, v_alpha_joint, v_alpha_static, v_alpha_dynamic, begin, inside)
                        for i in range(wp.static(columns)):
                            v_transmittances[i] = -v_alphas[i]
                        v_colors = read_color_gradients(
                            m,
                            v_image_joint,
                            v_image_static,
                            v_image_dynamic,
                            begin * wp.static(num_features),
                            inside * wp.static(num_features),
                        )
                        for c in range(wp.static(num_features)):
                            for i in range(wp.static(columns)):
                                v_color[c * wp.static(P) + row_begin + i] += v_colors[i * wp.static(num_features) + c]
                            if background.shape[0] > 0:
                                behind = background[m * background_stride + c]
                                for i in range(wp.static(columns)):
                                    v_transmittances[i] += behind * v_colors[i * wp.static(num_features) + c]
                        if wp.static(with_depth):
                            v_depths = read_gradients(m, v_depth_joint, v_depth_static, v_depth_dynamic, begin, inside)
                            depths = read_floats(depth, m * height * width + begin, inside)
                            for i in range(wp.static(columns)):
                                v_depth_sum = v_depths[i] / wp.max(1.0 - t_row[i], MIN_ALPHA)
                                v_color[wp.static(num_features * P) + row_begin + i] += v_depth_sum
                                v_transmittances[i] += v_depth_sum * depths[i]
                        for i in range(wp.static(columns)):
                            R[row_begin + i] += t_row[i] * v_transmittances[i]
            for k in range(wp.static(P)):
                n_max = wp.max(n_max, n[k])
        else:
            for j in range(wp.static(rows_per_lane)):
                for i in range(wp.static(columns)):
                    x = pixel_x + i * lane_columns()
                    y = pixel_y + j * lane_rows()
                    if x < width and y < height:
                        k = j * wp.static(columns) + i
                        pixel = y * width + x
                        T[k] = transmittance[list_image * height * width + pixel]
                        n[k] = last[list_image * height * width + pixel]
                        n_max = wp.max(n_max, n[k])
                        for m in range(own_image, wp.where(own_image == 0, wp.static(images), own_image + 1)):
                            if (image_bits & (1 << m)) != 0:
                                v_transmittance = -read_gradient(
                                    m, v_alpha_joint, v_alpha_static, v_alpha_dynamic, pixel, 1, 0
                                )
                                for c in range(wp.static(num_features)):
                                    v = read_gradient(
                                        m,
                                        v_image_joint,
                                        v_image_static,
                                        v_image_dynamic,
                                        pixel,
                                        wp.static(num_features),
                                        c,
                                    )
                                    v_color[c * wp.static(P) + k] += v
                                    if background.shape[0] > 0:
                                        v_transmittance += background[m * background_stride + c] * v
                                if wp.static(with_depth):
                                    v_depth = read_gradient(
                                        m, v_depth_joint, v_depth_static, v_depth_dynamic, pixel, 1, 0
                                    )
                                    v_depth_sum = v_depth / wp.max(1.0 - T[k], MIN_ALPHA)
                                    v_color[wp.static(num_features * P) + k] += v_depth_sum
                                    v_transmittance += v_depth_sum * depth[m * height * width + pixel]
                                R[k] += T[k] * v_transmittance
        n_max = lane_max(n_max)  # from here on, that of the lane group

        stage = stage_address()
        base = (n_max - 1) / lane_count() * lane_count()
        while base >= 0 and n_max > 0:
            index = base + lane
            own_g = int(-1)
            if index < n_max:
                own_g = gaussian_from_isect[isects[0] + isects[1] * index]
                if wp.static(images > 1):
                    own_g = own_g & ~DYNAMIC
            ballot, own0, own1, own2 = stage_survivors(own_g, index + 1, box, rows, lane, stage)
            count = lane_bit_count(ballot)
            for step in range(count):
                slot = count - 1 - step
                row0 = stage_get(stage, slot, 0, own0)
                row1 = stage_get(stage, slot, 1, own1)
                quad = stage_get(stage, slot, 2, own2)
                g = wp.cast(row1[2], wp.int32)
                position = wp.cast(row1[3], wp.int32)
                features = features_vector()
                for c in range(wp.static(min(C, 4))):
                    features[c] = quad[c]
                for c in range(4, wp.static(C)):
                    features[c] = row_load(rows, g, GEOMETRY_PARTS + c / 4)[c % 4]
                threshold = row1[1] - LOG2_ALPHA_MIN
                half_size = ellipse_half_size(row0[2], row0[3], row1[0], threshold)
                sums = sums_vector()
                contributes = int(0)
                for j in range(
                    span_begin(row0[1] - half_size[1] - y0, wp.static(rows_per_lane)),
                    span_end(row0[1] + half_size[1] - y0, wp.static(rows_per_lane)),
                ):
                    dy = row0[1] - (y0 + float(j * lane_rows()))
                    if wp.static(vectorized):
                        row_begin = wp.static(columns) * j & wp.static(P - 1)  # LLVM sees that it is not negative
                        for i in range(wp.static(columns)):
                            k = row_begin + i
                            dx = row0[0] - (x0 + float(i))
                            log2_alpha = row1[1] - ellipse_value(row0[2], row0[3], row1[0], dx, dy)
                            hit = log2_alpha >= LOG2_ALPHA_MIN and position <= n[k]
                            contributes = contributes | wp.where(hit, 1, 0)
                            unclamped = exp2(log2_alpha)
                            alpha = wp.where(hit, wp.min(max_alpha, unclamped), 0.0)
                            scale = 1.0 / (1.0 - alpha)
                            t = T[k] * scale
                            w = alpha * t
                            v_weight = float(0.0)
                            for c in range(wp.static(C)):
                                v = v_color[c * wp.static(P) + k]
                                v_weight += features[c] * v
                                sums[c * wp.static(columns) + i] += w * v
                            s = wp.where(unclamped <= max_alpha, alpha * (t * v_weight - R[k] * scale), 0.0)
                            R[k] = R[k] + w * v_weight
                            T[k] = t
                            sums[wp.static(C * columns) + i] += s
                            sums[wp.static((C + 1) * columns) + i] += s * dx
                            sums[wp.static((C + 2) * columns) + i] += s * dy
                            sums[wp.static((C + 3) * columns) + i] += s * dx * dx
                            sums[wp.static((C + 4) * columns) + i] += s * dx * dy
                            sums[wp.static((C + 5) * columns) + i] += s * dy * dy
                            if wp.static(absgrad):
                                v_x = wp.abs(s * (2.0 * row0[2] * dx + row0[3] * dy))
                                v_y = wp.abs(s * (row0[3] * dx + 2.0 * row1[0] * dy))
                                sums[wp.static((C + 6) * columns) + i] += LN_2 * v_x
                                sums[wp.static((C + 7) * columns) + i] += LN_2 * v_y
                    else:
                        span = ellipse_span(row0[2], row0[3], row1[0], threshold, dy)
                        for i in range(
                            span_begin(row0[0] - span[1] - x0, wp.static(columns)),
                            span_end(row0[0] - span[0] - x0, wp.static(columns)),
                        ):
                            dx = row0[0] - (x0 + float(i * lane_columns()))
                            log2_alpha = row1[1] - ellipse_value(row0[2], row0[3], row1[0], dx, dy)
                            if log2_alpha >= LOG2_ALPHA_MIN:
                                unclamped = exp2(log2_alpha)
                                alpha = wp.min(max_alpha, unclamped)
                                scale = 1.0 / (1.0 - alpha)
                                v_alpha = float(0.0)
                                k = j * wp.static(columns) + i
                                if position <= n[k]:
                                    contributes = 1
                                    t = T[k] * scale
                                    w = alpha * t
                                    v_weight = float(0.0)
                                    for c in range(wp.static(C)):
                                        v = v_color[c * wp.static(P) + k]
                                        v_weight += features[c] * v
                                        sums[c] += w * v
                                    v_alpha = t * v_weight - R[k] * scale
                                    R[k] = R[k] + w * v_weight
                                    T[k] = t
                                if unclamped <= max_alpha:
                                    s = alpha * v_alpha
                                    sums[wp.static(C)] += s
                                    sums[wp.static(C + 1)] += s * dx
                                    sums[wp.static(C + 2)] += s * dy
                                    sums[wp.static(C + 3)] += s * dx * dx
                                    sums[wp.static(C + 4)] += s * dx * dy
                                    sums[wp.static(C + 5)] += s * dy * dy
                                    if wp.static(absgrad):
                                        sums[wp.static(C + 6)] += LN_2 * wp.abs(s * (2.0 * row0[2] * dx + row0[3] * dy))
                                        sums[wp.static(C + 7)] += LN_2 * wp.abs(s * (row0[3] * dx + 2.0 * row1[0] * dy))
                if lane_any(contributes) != 0:
                    lane_add(sums, gradients, g)
            lane_sync()
            base -= lane_count()

    return composite_bwd
