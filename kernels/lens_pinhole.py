"""The pinhole lens: u, v = t_x / t_z, t_y / t_z, point (f_x u + c_x, f_y v + c_y).

J = [[f_x / t_z, 0, -f_x ū / t_z], [0, f_y / t_z, -f_y v̄ / t_z]],  ū, v̄ = u, v clamped to a margin around the image
"""

import warp as wp

from .constants import FIELD_OF_VIEW_MARGIN
from .lens import Distortion, mat23


@wp.func
def clamped_slope(slope: float, size: float, focal: float, center: float) -> float:
    """x / z, clamped to FIELD_OF_VIEW_MARGIN around the image, beyond which the local affine approximation fails."""
    margin = FIELD_OF_VIEW_MARGIN * 0.5 * size / focal
    return wp.clamp(slope, -center / focal - margin, (size - center) / focal + margin)


@wp.func
def pinhole_point(t: wp.vec3, focal: wp.vec2, center: wp.vec2, size: wp.vec2, distortion: Distortion, limit: float):
    """The point of the image and J; ``distortion`` and ``limit`` are not used."""
    rz = 1.0 / t[2]
    slope = wp.vec2(t[0] * rz, t[1] * rz)
    u = clamped_slope(slope[0], size[0], focal[0], center[0])
    v = clamped_slope(slope[1], size[1], focal[1], center[1])
    jacobian = mat23(focal[0] * rz, 0.0, -focal[0] * u * rz, 0.0, focal[1] * rz, -focal[1] * v * rz)
    return wp.cw_mul(focal, slope) + center, jacobian
