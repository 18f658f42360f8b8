"""A splat's row in memory: everything that compositing needs of one Gaussian, in 16-byte pieces.

    [x, y, a, b], [c, log2 opacity, 0, 0], [feature 0..3], [feature 4..7] …

with a = ½ log2(e) conic_xx, b = log2(e) conic_xy, c = ½ log2(e) conic_yy, so that
log2 alpha = log2 opacity - (a dx² + b dx dy + c dy²). A splat that is skipped (culled, with a feature that is not
finite, or with a conic that is singular in single precision) has log2 opacity CULLED_LOG2_OPACITY and radii of 0.

For each Gaussian, the backward pass of compositing leaves the gradients of its features and the moments of
s = alpha v_alpha over its pixels, and

    v_mean2d  = -conic Σ s d,                v_opacity = Σ s / opacity,
    v_conic_xx = -½ Σ s dx²,  v_conic_xy = -Σ s dx dy,  v_conic_yy = -½ Σ s dy².
"""

import functools

import warp as wp

from .constants import CULLED_DEPTH, CULLED_LOG2_OPACITY, LN_2, LOG2_E
from .lanes import exp2, native
from .scan import SCAN_BLOCK_DIM

GEOMETRY_PARTS = wp.constant(2)
"""vec4 values before the features."""

NUM_MOMENTS = 6
"""Σ s, Σ s dx, Σ s dy, Σ s dx², Σ s dx dy, Σ s dy²."""

NUM_ABSOLUTE_SUMS = 2
"""Σ |s (conic d)_x| and Σ |s (conic d)_y|."""


@wp.struct
class Splat:
    """A Gaussian as a camera sees it; all values of a culled one are zero."""

    mean: wp.vec2
    conic: wp.vec3
    depth: float
    opacity: float
    radius: wp.vec2i


# Warp's vec4 is aligned to 4 bytes, so a load or store takes four instructions; rows are aligned to 16: one is enough.
@wp.func_native(
    native(
        "const float4 v = *(const float4*)&wp::index(rows, i, part); return wp::vec4(v.x, v.y, v.z, v.w);",
        "return wp::index(rows, i, part);",
    )
)
def row_load(rows: wp.array2d[wp.vec4], i: int, part: int) -> wp.vec4: ...


@wp.func_native(
    native(
        "*(float4*)&wp::index(rows, i, part) = make_float4(value[0], value[1], value[2], value[3]);",
        "wp::index(rows, i, part) = value;",
    )
)
def row_store(rows: wp.array2d[wp.vec4], i: int, part: int, value: wp.vec4): ...


@wp.func
def is_culled(rows: wp.array2d[wp.vec4], i: int) -> bool:
    return row_load(rows, i, 1)[1] == CULLED_LOG2_OPACITY


def row_parts(num_channels: int) -> int:
    """Number of vec4 values in a row with ``num_channels`` features."""
    return GEOMETRY_PARTS + (num_channels + 3) // 4


def gradient_stride(num_channels: int) -> int:
    """Number of floats in a Gaussian's gradient row: features, moments, ``NUM_ABSOLUTE_SUMS``, padded to 16 bytes."""
    return (num_channels + NUM_MOMENTS + NUM_ABSOLUTE_SUMS + 3) // 4 * 4


@functools.cache
def make_pack_splat(num_features: int, with_depth: bool) -> wp.Function:
    """Function that writes a row; depth is an optional last channel.

    It also writes the input of the depth sort, a key and the splat's own index, and the zeros that this sort and the
    prefix sum of intersections need (see ``sort`` and ``scan``), and returns whether the splat is not skipped.
    """
    num_channels = num_features + int(with_depth)

    @wp.func
    def pack_splat(
        i: int,
        splat: Splat,
        features: wp.array2d[float],
        rows: wp.array2d[wp.vec4],
        depth_keys: wp.array[int],
        gaussian_from_rank: wp.array[int],
        scan_words: wp.array[wp.int64],
        sort_counters: wp.array[int],
    ) -> bool:
        mean = splat.mean
        conic = splat.conic
        depth = splat.depth
        total = float(0.0)  # a sum is finite only if all of its terms are
        for part in range(wp.static((num_channels + 3) // 4)):
            value = wp.vec4(0.0)
            for k in range(4):
                if part * 4 + k < wp.static(num_features):
                    value[k] = features[i, part * 4 + k]
                elif part * 4 + k < wp.static(num_channels):
                    value[k] = depth
            total += value[0] + value[1] + value[2] + value[3]
            row_store(rows, i, wp.static(GEOMETRY_PARTS) + part, value)
        visible = splat.radius[0] > 0 and wp.isfinite(total) and conic[0] * conic[2] > conic[1] * conic[1]
        key = CULLED_DEPTH
        row0 = wp.vec4(0.0)
        row1 = wp.vec4(0.0, CULLED_LOG2_OPACITY, 0.0, 0.0)
        if visible:
            key = wp.cast(depth, wp.int32)  # the bits of positive floats have the order of the floats
            row0 = wp.vec4(mean[0], mean[1], 0.5 * LOG2_E * conic[0], LOG2_E * conic[1])
            row1 = wp.vec4(0.5 * LOG2_E * conic[2], wp.log2(splat.opacity), 0.0, 0.0)
        row_store(rows, i, 0, row0)
        row_store(rows, i, 1, row1)
        depth_keys[i] = key
        gaussian_from_rank[i] = i
        if i % SCAN_BLOCK_DIM == 0:
            scan_words[i / SCAN_BLOCK_DIM] = wp.int64(0)
        for k in range(i, sort_counters.shape[0], rows.shape[0]):
            sort_counters[k] = 0
        return visible

    return pack_splat


sums_vector = wp.types.vector(length=NUM_MOMENTS + NUM_ABSOLUTE_SUMS, dtype=float)


@functools.cache
def make_unpack_splat(num_features: int, with_depth: bool) -> wp.Function:
    """Function that turns a gradient row into the gradients of a splat, features and ``screen_offsets``.

    ``gradients`` has the rows of all splats once for each CPU shard; on CUDA, once. ``v_screen_offsets``, which may be
    missing, is the gradient of the mean in halves of the image size; the sum of absolute values if ``absgrad`` is 1.
    """
    num_channels = num_features + int(with_depth)

    @wp.func
    def unpack_splat(
        i: int,
        rows: wp.array2d[wp.vec4],
        gradients: wp.array2d[wp.vec4],
        width: int,
        height: int,
        absgrad: int,
        v_features: wp.array2d[float],
        v_screen_offsets: wp.array[wp.vec2],
    ) -> Splat:
        v_splat = Splat()
        s = sums_vector()
        for part in range(wp.static(gradient_stride(num_channels) // 4)):
            total = wp.vec4(0.0)
            for row in range(i, gradients.shape[0], rows.shape[0]):  # of each shard
                total += row_load(gradients, row, part)
            for k in range(4):
                if part * 4 + k < wp.static(num_features):
                    v_features[i, part * 4 + k] = total[k]
                elif part * 4 + k < wp.static(num_channels):
                    v_splat.depth = total[k]
                elif part * 4 + k < wp.static(num_channels + NUM_MOMENTS + NUM_ABSOLUTE_SUMS):
                    s[part * 4 + k - wp.static(num_channels)] = total[k]
        v_offset = wp.vec2(0.0)
        if not is_culled(rows, i):
            row0 = row_load(rows, i, 0)
            row1 = row_load(rows, i, 1)
            conic = LN_2 * wp.vec3(2.0 * row0[2], row0[3], 2.0 * row1[0])
            v_splat.mean = -wp.vec2(conic[0] * s[1] + conic[1] * s[2], conic[1] * s[1] + conic[2] * s[2])
            v_splat.conic = -wp.vec3(0.5 * s[3], s[4], 0.5 * s[5])
            v_splat.opacity = s[0] / exp2(row1[1])
            v_offset = v_splat.mean
            if absgrad != 0:
                v_offset = wp.vec2(s[6], s[7])
        if v_screen_offsets.shape[0] > 0:
            v_screen_offsets[i] = wp.vec2(v_offset[0] * 0.5 * float(width), v_offset[1] * 0.5 * float(height))
        return v_splat

    return unpack_splat
