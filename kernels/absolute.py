"""The slope of an absolute value, for the ways back of L1 losses."""

import warp as wp


@wp.func
def slope_of_abs(x: float) -> float:
    """d|x| / dx; 0 at 0 and for NaN, as torch has it at 0."""
    return wp.where(x > 0.0, 1.0, 0.0) - wp.where(x < 0.0, 1.0, 0.0)
