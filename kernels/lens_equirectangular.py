"""The equirectangular lens of panoramas: longitude and latitude, with OpenSfM's axes and signs.

With ρ = |(t_x, t_z)| and R = |t|, the middle of a full image looks along z, x is to its right and y is downward:

    longitude = atan2(t_x, t_z),  latitude = atan2(t_y, ρ),  point = focal · (longitude, latitude) + center
    J = diag(focal) [[t_z / ρ², 0, -t_x / ρ²], [-t_x t_y / (ρ R²), ρ / R², -t_y t_z / (ρ R²)]]

The focal lengths are pixels per radian: width / 2π and height / π of a full image. The directions right above and below
have no longitude. The depth of a splat is its distance from the camera.
"""

import warp as wp

from .lens import Distortion, mat23


@wp.func
def equirectangular_point(
    t: wp.vec3, focal: wp.vec2, center: wp.vec2, size: wp.vec2, distortion: Distortion, limit: float
):
    """The point of the image and J; ``size``, ``distortion`` and ``limit`` are not used."""
    x = t[0]
    y = t[1]
    z = t[2]
    rho2 = x * x + z * z
    rho = wp.sqrt(rho2)
    across = 1.0 / rho2
    along = 1.0 / (rho2 + y * y)
    lean = y * along / rho
    point = wp.vec2(focal[0] * wp.atan2(x, z) + center[0], focal[1] * wp.atan2(y, rho) + center[1])
    jacobian = mat23(
        focal[0] * z * across,
        0.0,
        -focal[0] * x * across,
        -focal[1] * x * lean,
        focal[1] * rho * along,
        -focal[1] * z * lean,
    )
    return point, jacobian
