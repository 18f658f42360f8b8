"""Depth against aligned monocular depth (paper Eq. 14).

Monocular depth is inverse and known up to a scale and an offset, target = 1 / (scale inverse + offset). Per pixel,

    error = |depth - target|,      v_depth = v sign(depth - target),

and both are 0 where there is nothing to compare: outside the region, where less than half of the light comes from what
was drawn, and where the target is unknown (NaN fails the comparison) or next to infinity.
"""

import warp as wp

from .absolute import slope_of_abs
from .constants import MIN_INVERSE_DEPTH

OPAQUE = wp.constant(0.5)
"""Opacity that a pixel must exceed to have a depth to speak of."""


@wp.func
def depth_difference(
    depth: wp.array[float],
    alpha: wp.array[float],
    inverse_depth: wp.array[float],
    alignment: wp.array[float],
    region: wp.array[wp.uint8],
    p: int,
) -> float:
    """Depth minus target; 0 where there is nothing to compare."""
    result = float(0.0)
    aligned = alignment[0] * inverse_depth[p] + alignment[1]
    if region[p] != wp.uint8(0) and alpha[p] > OPAQUE and aligned > MIN_INVERSE_DEPTH:
        result = depth[p] - 1.0 / aligned
    return result


@wp.kernel(enable_backward=False)
def depth_error_fwd(
    first: int,
    depth: wp.array[float],
    alpha: wp.array[float],
    inverse_depth: wp.array[float],
    alignment: wp.array[float],
    region: wp.array[wp.uint8],
    errors: wp.array[float],
):
    """One thread for each pixel."""
    p = first + wp.tid()
    errors[p] = wp.abs(depth_difference(depth, alpha, inverse_depth, alignment, region, p))


@wp.kernel(enable_backward=False)
def depth_error_bwd(
    first: int,
    depth: wp.array[float],
    alpha: wp.array[float],
    inverse_depth: wp.array[float],
    alignment: wp.array[float],
    region: wp.array[wp.uint8],
    scale: float,
    v_sum: wp.array[float],
    v_depth: wp.array[float],
):
    """``v_sum`` [1]: cotangent of the sum of all errors, times ``scale``."""
    p = first + wp.tid()
    difference = depth_difference(depth, alpha, inverse_depth, alignment, region, p)
    v_depth[p] = scale * v_sum[0] * slope_of_abs(difference)
