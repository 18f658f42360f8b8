"""Shutters: from a point in the axes of the camera at its middle row to its point in the image, J and its depth.

With a global shutter that is the lens. With a rolling shutter, the rows of an image are read one after another, while
the camera turns by the rotation vector Ω and moves by v, in its own axes: at s = y / height - ½ of the readout a point
t has the coordinates and the velocity

    t(s) = R(-s Ω) (t - s v),   t'(s) = -Ω × t(s) - R(-s Ω) v

and its image w = J t'(s). The row at which it is seen solves y(t(s)) = (s + ½) height. One step of Newton's method from
the middle row does so up to the curvature of its path, which a step of the fixed point s = y / height - ½ would follow
only once:

    s = (y / height - ½) / (1 - w_y / height)   at t(0)

How the image changes with t includes that another row sees it: with J and w at t(s),

    J_t = [[1, w_x / (height - w_y)], [0, height / (height - w_y)]] J R(-s Ω)

which shears splats as the shutter does. Where columns are read one after another, x and width take the places of y and
height, as in a phone held upright. Above and below the image the motion continues, up to ``MAX_READOUT``.
R(a) = 1 + f [a] + g [a]², with [a] the matrix of a × and f = sin|a| / |a| and g = (1 - cos|a|) / |a|² as series
in |a|².
"""

import functools

import warp as wp

from .lens import Distortion, mat23
from .lenses import LensKernels

MAX_READOUT = wp.constant(1.0)
"""How far from the middle row the pose is extrapolated, in readouts; the image ends at ½."""

MIN_PROGRESS = wp.constant(0.25)
"""Lower bound of 1 - w_y / height, the speed at which the readout overtakes a point: keeps its row finite."""


@wp.func
def rotation_of(a: wp.vec3) -> wp.mat33:
    """R(a); the next terms of the series are 1e-6 at |a| = π / 2."""
    q = wp.length_sq(a)
    f = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0)))
    g = 0.5 - q / 24.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (1.0 - q / 90.0)))
    turning = wp.skew(a)
    return wp.identity(n=3, dtype=float) + f * turning + g * (turning * turning)


@functools.cache
def make_load_motion(is_rolling: bool) -> wp.Function:
    """Function that loads Ω and v of a rolling shutter; of a global shutter they are constants."""

    @wp.func
    def load_motion(motion: wp.array[wp.vec3]):
        turn = wp.vec3(0.0)
        move = wp.vec3(0.0)
        if wp.static(is_rolling):
            turn = motion[0]
            move = motion[1]
        return turn, move

    return load_motion


@functools.cache
def make_shutter(lens: LensKernels, is_rolling: bool, by_columns: bool) -> wp.Function:
    """Function from a point to its point in the image, the Jacobian and its depth."""
    return make_rolling_shutter(lens, by_columns) if is_rolling else make_global_shutter(lens)


def make_global_shutter(lens: LensKernels) -> wp.Function:
    """The lens; ``turn`` and ``move`` are not used."""
    lens_point, is_wide = lens.point, lens.is_wide

    @wp.func
    def global_shutter(
        t: wp.vec3,
        turn: wp.vec3,
        move: wp.vec3,
        focal: wp.vec2,
        center: wp.vec2,
        size: wp.vec2,
        distortion: Distortion,
        limit: float,
    ):
        point, jacobian = lens_point(t, focal, center, size, distortion, limit)
        depth = t[2]
        if wp.static(is_wide):
            depth = wp.length(t)
        return point, jacobian, depth

    return global_shutter


def make_rolling_shutter(lens: LensKernels, by_columns: bool) -> wp.Function:
    """The lens at the row that sees a point, for Ω = ``turn`` and v = ``move``; depth is 0 beyond its largest angle."""
    lens_point, is_wide = lens.point, lens.is_wide
    along = 0 if by_columns else 1  # the axis of the image along which lines are read

    @wp.func
    def rolling_shutter(
        t: wp.vec3,
        turn: wp.vec3,
        move: wp.vec3,
        focal: wp.vec2,
        center: wp.vec2,
        size: wp.vec2,
        distortion: Distortion,
        limit: float,
    ):
        middle, middle_jacobian = lens_point(t, focal, center, size, distortion, limit)
        middle_velocity = middle_jacobian * (wp.cross(t, turn) - move)
        progress = wp.max(1.0 - middle_velocity[wp.static(along)] / size[wp.static(along)], MIN_PROGRESS)
        s = wp.clamp((middle[wp.static(along)] / size[wp.static(along)] - 0.5) / progress, -MAX_READOUT, MAX_READOUT)

        rotation = rotation_of(-s * turn)
        at_row = rotation * (t - s * move)
        point, jacobian = lens_point(at_row, focal, center, size, distortion, limit)
        velocity = jacobian * (wp.cross(at_row, turn) - rotation * move)
        row_progress = wp.max(1.0 - velocity[wp.static(along)] / size[wp.static(along)], MIN_PROGRESS)
        shear = wp.mat22(1.0, velocity[0] / (size[1] * row_progress), 0.0, 1.0 / row_progress)
        if wp.static(by_columns):
            shear = wp.mat22(1.0 / row_progress, 0.0, velocity[1] / (size[0] * row_progress), 1.0)
        depth = at_row[2]
        if wp.static(is_wide):
            distance = wp.length(at_row)
            depth = wp.where(at_row[2] >= distance * wp.cos(limit), distance, 0.0)
        return point, shear * jacobian * rotation, depth

    return rolling_shutter


@functools.cache
def make_shutter_sum(lens: LensKernels, is_rolling: bool, by_columns: bool) -> wp.Function:
    """Function whose gradient is the backward pass: v_point · point, v_jacobian : J and v_depth · depth."""
    shutter = make_shutter(lens, is_rolling, by_columns)

    @wp.func
    def shutter_sum(
        t: wp.vec3,
        turn: wp.vec3,
        move: wp.vec3,
        focal: wp.vec2,
        center: wp.vec2,
        size: wp.vec2,
        distortion: Distortion,
        limit: float,
        v_point: wp.vec2,
        v_jacobian: mat23,
        v_depth: float,
    ) -> wp.vec3:
        point, jacobian, depth = shutter(t, turn, move, focal, center, size, distortion, limit)
        return wp.vec3(wp.dot(v_point, point), wp.ddot(v_jacobian, jacobian), v_depth * depth)

    return shutter_sum
