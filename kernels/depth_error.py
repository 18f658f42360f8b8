"""Depth against aligned monocular depth (paper Eq. 14).

Monocular depth is inverse depth up to a scale and an offset, so target = 1 / (scale inverse + offset). For each pixel,

    error = max(|depth - target| - margin target, 0),      v_depth = v sign(depth - target) where error > 0.

The margin is the relative error of the target; with a margin of 0 this is Eq. 14. Both are 0 in pixels that are not
compared: outside the region, where the rendered opacity is at most a half, and where the target is unknown (NaN fails
the comparison) or close to infinity.
"""

import warp as wp

from .absolute import abs_derivative
from .constants import MIN_INVERSE_DEPTH

MIN_OPACITY = wp.constant(0.5)
"""A pixel is compared if its opacity exceeds this."""


@wp.func
def depth_difference(
    depth: wp.array[float],
    alpha: wp.array[float],
    inverse_depth: wp.array[float],
    alignment: wp.array[float],
    margin: wp.array[float],
    region: wp.array[wp.uint8],
    p: int,
) -> float:
    """Depth minus the nearest end of target ± margin; 0 between these, and in pixels that are not compared."""
    result = float(0.0)
    aligned = alignment[0] * inverse_depth[p] + alignment[1]
    if region[p] != wp.uint8(0) and alpha[p] > MIN_OPACITY and aligned > MIN_INVERSE_DEPTH:
        target = 1.0 / aligned
        difference = depth[p] - target
        allowed = margin[0] * target
        result = difference - wp.clamp(difference, -allowed, allowed)
    return result


@wp.kernel(enable_backward=False)
def depth_error_fwd(
    first: int,
    depth: wp.array[float],
    alpha: wp.array[float],
    inverse_depth: wp.array[float],
    alignment: wp.array[float],
    margin: wp.array[float],
    region: wp.array[wp.uint8],
    errors: wp.array[float],
):
    """One thread for each pixel."""
    p = first + wp.tid()
    errors[p] = wp.abs(depth_difference(depth, alpha, inverse_depth, alignment, margin, region, p))


@wp.kernel(enable_backward=False)
def depth_error_bwd(
    first: int,
    depth: wp.array[float],
    alpha: wp.array[float],
    inverse_depth: wp.array[float],
    alignment: wp.array[float],
    margin: wp.array[float],
    region: wp.array[wp.uint8],
    scale: float,
    v_sum: wp.array[float],
    v_depth: wp.array[float],
):
    """One thread for each pixel; ``v_sum`` [1] times ``scale`` is the gradient of the sum of all errors."""
    p = first + wp.tid()
    difference = depth_difference(depth, alpha, inverse_depth, alignment, margin, region, p)
    v_depth[p] = scale * v_sum[0] * abs_derivative(difference)
