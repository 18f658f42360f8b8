"""The derivative of an absolute value, for the backward passes of L1 losses."""

import warp as wp


@wp.func
def abs_derivative(x: float) -> float:
    """d|x| / dx; 0 at 0, as in torch, and for NaN."""
    return wp.where(x > 0.0, 1.0, 0.0) - wp.where(x < 0.0, 1.0, 0.0)
