"""The ellipse a dx² + b dx dy + c dy² <= t around its centre in which a splat is visible.

The coefficients are those of a splat's row (see ``rows``) and t = log2 opacity - log2 ALPHA_MIN, so that alpha >=
ALPHA_MIN exactly inside the ellipse: an opacity-aware extent instead of a multiple of the standard deviation.
"""

import warp as wp


@wp.func
def ellipse_value(a: float, b: float, c: float, dx: float, dy: float) -> float:
    """a dx² + b dx dy + c dy²."""
    return dx * (a * dx + b * dy) + c * dy * dy


@wp.func
def ellipse_half_size(a: float, b: float, c: float, t: float) -> wp.vec2:
    """Half width and half height of the bounding box, sqrt(t Σ_xx) and sqrt(t Σ_yy) with Σ the inverse of the form."""
    scale = t / (a * c - 0.25 * b * b)
    return wp.vec2(wp.sqrt(scale * c), wp.sqrt(scale * a))


@wp.func
def ellipse_meets_box(
    a: float, b: float, c: float, t: float, x_min: float, y_min: float, x_max: float, y_max: float
) -> bool:
    """Whether the ellipse reaches into a box, given by its corners relative to the ellipse's centre.

    The form is convex, so its minimum over the box lies at the centre or on an edge that faces the centre: it is
    minimised in closed form over the nearest vertical and the nearest horizontal edge, and the smaller value is taken.
    """
    dx = wp.clamp(0.0, x_min, x_max)
    dy = wp.clamp(0.0, y_min, y_max)
    on_vertical = ellipse_value(a, b, c, dx, wp.clamp(-0.5 * b * dx / c, y_min, y_max))
    on_horizontal = ellipse_value(a, b, c, wp.clamp(-0.5 * b * dy / a, x_min, x_max), dy)
    return wp.min(on_vertical, on_horizontal) <= t


@wp.func
def ellipse_span(a: float, b: float, c: float, t: float, dy: float) -> wp.vec2:
    """The interval of dx inside the ellipse at a height dy; empty (first above second) if the line misses it."""
    half_b = 0.5 * b * dy
    discriminant = half_b * half_b - a * (c * dy * dy - t)
    if not (discriminant >= 0.0):
        return wp.vec2(1.0, -1.0)
    root = wp.sqrt(discriminant)
    scale = 1.0 / a
    return wp.vec2((-half_b - root) * scale, (-half_b + root) * scale)


@wp.func
def ellipse_slab(a: float, b: float, c: float, t: float, half_size: wp.vec2, y_min: float, y_max: float) -> wp.vec2:
    """The interval of dx that the ellipse covers within the slab y_min <= dy <= y_max.

    The leftmost and the rightmost point of the ellipse lie at dy = ± half_width b / (2c); if that height is outside the
    slab, the nearest height of the slab that the ellipse reaches is used instead.
    """
    low = wp.max(y_min, -half_size[1])
    high = wp.min(y_max, half_size[1])
    tip = 0.5 * b * half_size[0] / c
    left = ellipse_span(a, b, c, t, wp.clamp(tip, low, high))
    right = ellipse_span(a, b, c, t, wp.clamp(-tip, low, high))
    return wp.vec2(left[0], right[1])
