"""Alpha compositing, front to back (paper Eq. 4).

A pixel p composites the Gaussians of its tile in depth order; with d = mean2d - p,

    alpha_i = min(max_alpha, opacity_i exp(-½ dᵀ conic_i d)),  skipped below ALPHA_MIN,
    T_0 = 1,  T_{i+1} = T_i (1 - alpha_i),  stopped before T would fall to TRANSMITTANCE_MIN,
    image = Σ_i alpha_i T_i feature_i + T_end background.

Depth, the channel after the image's, has no background and is normalised: divided by max(alpha, MIN_ALPHA). The median
depth instead is that of the last Gaussian with T_i > ½, as in 2DGS (Huang et al. 2024).

With branches, one launch makes three images: 0 joint, 1 static Gaussians only, 2 dynamic Gaussians only. Each image has
its own lane groups, which traverse its own lists: with the state of a single image more groups fit on a multiprocessor,
and no group has to skip Gaussians of another image. Where the joint image of a block evaluated Gaussians of one branch
only, the image of that branch is the same, and the group of the joint image writes both. The groups of the joint image
come first in the launch, so that most groups of a branch read in ``joint_state`` that nothing is left to do. A group
that runs before this is known writes the same bits again.

The transmittance of a pixel is negated once the pixel is complete.

On CUDA a lane owns one or two pixels and skips what does not reach them. On CPU it owns a whole tile and composites all
pixels of a row at once, with selections instead of branches (``is_vectorized``).
"""

import functools

import warp as wp

from .blocks import (
    Counter,
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
from .constants import LOG2_ALPHA_MIN, MIN_ALPHA, TRANSMITTANCE_MIN
from .ellipse import ellipse_half_size, ellipse_span, ellipse_value
from .lanes import (
    exp2,
    lane_any,
    lane_bit_count,
    lane_columns,
    lane_count,
    lane_or,
    lane_rows,
    lane_sum,
    lane_sync,
    span_begin,
    span_end,
    stage_address,
    stage_get,
)
from .pixel_rows import make_write_row
from .rows import GEOMETRY_PARTS, row_load
from .tiles import DYNAMIC


@functools.cache
def make_composite_fwd(
    num_features: int, with_depth: bool, images: int, pixels: tuple[int, int], statistics: bool, median: bool = False
) -> wp.Kernel:
    """Forward kernel, ``lane_count()`` threads for each block of pixels in each image.

    Args:
        num_features: Channels of an image, at least 1.
        with_depth: Whether the depth of the Gaussians is one more channel.
        images: 1 or 3, see above; ``branch_lengths``, ``half`` and ``joint_state`` are only used with 3.
        pixels: Columns and rows of the pixels that a lane owns.
        statistics: Whether ``contributed`` and ``weights`` are written; they describe the joint image.
        median: Whether the depth is the median.

    The kernel's ``background`` has ``num_features`` values per image, ``background_stride`` apart. ``joint_state`` has
    one value for each block of an image, initially zero; see ``equals_joint``. ``transmittance`` and ``last`` are saved
    for the backward pass by the traversal of each image; they may be unset where an image equals the joint image.
    """
    C = num_features + int(with_depth)
    num_sums = num_features if median else C
    columns, rows_per_lane = pixels
    P = columns * rows_per_lane
    vectorized = is_vectorized(pixels)
    scalars, integers, colors, features_vector = state_types(C, P)
    # With branches, the lowest two bits of a Gaussian's tag encode its branch, and those of a pixel's tag all branches
    # that it has evaluated; the other bits are the position in the list. (In lists of one branch they are not used.)
    branch_bits = 3 if images > 1 else 0
    float_row, write_floats = make_write_row(columns)
    int_row, write_ints = make_write_row(columns, int)
    color_row, write_colors = make_write_row(columns * num_features, float, ndim=2)

    @wp.kernel(enable_backward=False, module="unique", module_options=module_options(P))
    def composite_fwd(
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
        image: wp.array2d[float],
        depth: wp.array[float],
        alpha_image: wp.array[float],
        transmittance: wp.array[float],
        last: wp.array[int],
        joint_state: wp.array[int],
        contributed: wp.array[wp.uint8],
        weights: wp.array[float],
    ):
        thread = first + wp.tid()
        lane = thread % lane_count()
        block_width = lane_columns() * wp.static(columns)
        block_height = lane_rows() * wp.static(rows_per_lane)
        num_blocks = tile_ranges.shape[0] * blocks_of_tile(block_width, block_height)
        own_image = thread / lane_count() / num_blocks
        block = thread / lane_count() % num_blocks
        corner = block_corner(block, width, block_width, block_height)
        if corner[1] >= width or corner[2] >= height:
            return  # this block of an edge tile is outside the image; its whole lane group returns
        isects = tile_list(own_image, corner[0], tile_ranges, branch_lengths, half)
        if wp.static(images > 1):
            if own_image > 0:
                # In a tile without Gaussians of the other branch it is known in advance. Lanes may read ``joint_state``
                # at different times, so they vote.
                all_isects = tile_list(0, corner[0], tile_ranges, branch_lengths, half)
                if lane_any(int(isects[2] == all_isects[2] or equals_joint(own_image, joint_state[block]))) != 0:
                    return  # the lane group of the joint image writes this image, too
        box = block_box(corner, block_width, block_height, width, height)
        pixel_x = corner[1] + lane % lane_columns()
        pixel_y = corner[2] + lane / lane_columns()
        x0 = float(pixel_x) + 0.5
        y0 = float(pixel_y) + 0.5

        T = scalars()
        n = integers()
        color = colors()
        open_pixels = Counter()  # of this lane
        for j in range(wp.static(rows_per_lane)):
            for i in range(wp.static(columns)):
                if pixel_x + i * lane_columns() < width and pixel_y + j * lane_rows() < height:
                    T[j * wp.static(columns) + i] = 1.0
                    open_pixels[0] += 1

        stage = stage_address()
        base = int(0)
        while base < isects[2]:
            if lane_any(open_pixels[0]) == 0:
                break
            own_g = int(-1)
            own_tag = base + lane + 1
            if base + lane < isects[2]:
                own_g = gaussian_from_isect[isects[0] + isects[1] * (base + lane)]
                if wp.static(images > 1):
                    own_tag = 4 * own_tag + wp.where(own_g < DYNAMIC, 1, 2)
                    own_g = own_g & ~DYNAMIC
            ballot, own0, own1, own2 = stage_survivors(own_g, own_tag, box, rows, lane, stage)
            for slot in range(lane_bit_count(ballot)):
                row0 = stage_get(stage, slot, 0, own0)
                row1 = stage_get(stage, slot, 1, own1)
                quad = stage_get(stage, slot, 2, own2)
                g = wp.cast(row1[2], wp.int32)
                tag = wp.cast(row1[3], wp.int32)
                features = features_vector()
                for c in range(wp.static(min(C, 4))):
                    features[c] = quad[c]
                for c in range(4, wp.static(C)):
                    features[c] = row_load(rows, g, GEOMETRY_PARTS + c / 4)[c % 4]
                threshold = row1[1] - LOG2_ALPHA_MIN
                half_size = ellipse_half_size(row0[2], row0[3], row1[0], threshold)
                weight = float(0.0)
                closed = int_row()
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
                            t = T[k]
                            tags = n[k]
                            hit = log2_alpha >= LOG2_ALPHA_MIN and t > 0.0
                            alpha = wp.where(hit, wp.min(max_alpha, exp2(log2_alpha)), 0.0)
                            t_next = t - alpha * t
                            closes = hit and t_next <= TRANSMITTANCE_MIN
                            w = wp.where(closes, 0.0, alpha * t)
                            for c in range(wp.static(num_sums)):
                                color[c * wp.static(P) + k] += w * features[c]
                            if wp.static(num_sums < C):
                                d = wp.static(num_features * P) + k
                                color[d] = wp.where(w > 0.0 and t > 0.5, features[wp.static(num_features)], color[d])
                            T[k] = wp.where(closes, -t, t_next)
                            seen = (tags | tag) & wp.static(branch_bits)
                            n[k] = wp.where(hit, seen | wp.where(closes, tags, tag), tags)
                            closed[i] += wp.where(closes, 1, 0)
                            if wp.static(statistics):
                                weight += w
                    else:
                        span = ellipse_span(row0[2], row0[3], row1[0], threshold, dy)
                        for i in range(
                            span_begin(row0[0] - span[1] - x0, wp.static(columns)),
                            span_end(row0[0] - span[0] - x0, wp.static(columns)),
                        ):
                            dx = row0[0] - (x0 + float(i * lane_columns()))
                            log2_alpha = row1[1] - ellipse_value(row0[2], row0[3], row1[0], dx, dy)
                            if log2_alpha >= LOG2_ALPHA_MIN:
                                alpha = wp.min(max_alpha, exp2(log2_alpha))
                                k = j * wp.static(columns) + i
                                t = T[k]
                                if t > 0.0:
                                    t_next = t - alpha * t
                                    if t_next <= TRANSMITTANCE_MIN:
                                        T[k] = -t
                                        open_pixels[0] -= 1
                                        n[k] = n[k] | (tag & wp.static(branch_bits))
                                    else:
                                        w = alpha * t
                                        for c in range(wp.static(num_sums)):
                                            color[c * wp.static(P) + k] += w * features[c]
                                        if wp.static(num_sums < C):
                                            if t > 0.5:
                                                color[wp.static(num_features * P) + k] = features[
                                                    wp.static(num_features)
                                                ]
                                        T[k] = t_next
                                        n[k] = tag | (n[k] & wp.static(branch_bits))
                                        weight += w
                if wp.static(vectorized):
                    for i in range(wp.static(columns)):
                        open_pixels[0] -= closed[i]
                if wp.static(statistics) and own_image == 0:
                    weight = lane_sum(weight)
                    if lane == 0 and weight > 0.0:
                        contributed[g] = wp.uint8(1)
                        wp.atomic_add(weights, g, weight)
            lane_sync()
            base += lane_count()

        own_state = int(1)
        if wp.static(images > 1):
            branches_seen = int(0)
            for k in range(wp.static(P)):
                branches_seen = branches_seen | (n[k] & wp.static(branch_bits))
            own_state = 1 | 2 * lane_or(branches_seen)
            if own_image == 0 and lane == 0:
                joint_state[block] = own_state
        if wp.static(vectorized):
            inside = wp.min(wp.static(columns), width - pixel_x)
            t_row = float_row()
            last_row = int_row()
            alpha_row = float_row()
            depth_row = float_row()
            image_row = color_row()
            for j in range(wp.min(wp.static(rows_per_lane), height - pixel_y)):
                row_begin = wp.static(columns) * j & wp.static(P - 1)
                for i in range(wp.static(columns)):
                    t_row[i] = wp.abs(T[row_begin + i])
                    last_row[i] = n[row_begin + i] / wp.static(branch_bits + 1)
                    alpha_row[i] = 1.0 - t_row[i]
                own_begin = (own_image * height + pixel_y + j) * width + pixel_x
                write_floats(transmittance, own_begin, inside, t_row)
                write_ints(last, own_begin, inside, last_row)
                for m in range(own_image, wp.where(own_image == 0, wp.static(images), own_image + 1)):
                    if m == own_image or equals_joint(m, own_state):
                        begin = (m * height + pixel_y + j) * width + pixel_x
                        write_floats(alpha_image, begin, inside, alpha_row)
                        for c in range(wp.static(num_features)):
                            for i in range(wp.static(columns)):
                                image_row[i * wp.static(num_features) + c] = color[c * wp.static(P) + row_begin + i]
                            if background.shape[0] > 0:
                                behind = background[m * background_stride + c]
                                for i in range(wp.static(columns)):
                                    image_row[i * wp.static(num_features) + c] += t_row[i] * behind
                        write_colors(
                            image, begin * wp.static(num_features), inside * wp.static(num_features), image_row
                        )
                        if wp.static(num_features < C):
                            for i in range(wp.static(columns)):
                                found = color[wp.static(num_features * P) + row_begin + i]
                                depth_row[i] = found / wp.where(
                                    wp.static(num_sums < C), 1.0, wp.max(alpha_row[i], MIN_ALPHA)
                                )
                            write_floats(depth, begin, inside, depth_row)
        else:
            for j in range(wp.static(rows_per_lane)):
                for i in range(wp.static(columns)):
                    x = pixel_x + i * lane_columns()
                    y = pixel_y + j * lane_rows()
                    if x < width and y < height:
                        k = j * wp.static(columns) + i
                        t = wp.abs(T[k])
                        own_pixel = (own_image * height + y) * width + x
                        transmittance[own_pixel] = t
                        last[own_pixel] = n[k] / wp.static(branch_bits + 1)
                        for m in range(own_image, wp.where(own_image == 0, wp.static(images), own_image + 1)):
                            if m == own_image or equals_joint(m, own_state):
                                p = (m * height + y) * width + x
                                alpha_image[p] = 1.0 - t
                                for c in range(wp.static(num_features)):
                                    value = color[c * wp.static(P) + k]
                                    if background.shape[0] > 0:
                                        value += t * background[m * background_stride + c]
                                    image[p, c] = value
                                if wp.static(num_features < C):
                                    found = color[wp.static(num_features * P) + k]
                                    depth[p] = found / wp.where(
                                        wp.static(num_sums < C), 1.0, wp.max(1.0 - t, MIN_ALPHA)
                                    )

    return composite_fwd
