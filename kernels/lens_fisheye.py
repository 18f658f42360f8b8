"""The fisheye lens of Kannala and Brandt 2006, as OpenCV has it (COLMAP's OPENCV_FISHEYE and its RADIAL_FISHEYE).

With ρ = |(t_x, t_y)|, R² = ρ² + t_z², θ = atan2(ρ, t_z) the angle from the axis, coefficients k1, k2, k3, k4:

    θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),  g = θ_d / ρ,  point = focal · g (t_x, t_y) + center
    ∂g/∂t_x = h t_x,  ∂g/∂t_y = h t_y,  h = (θ_d' t_z / R² - g) / ρ²,  ∂g/∂t_z = -θ_d' / R²

g and h are even functions of ρ. Near the axis, where the differences cancel, they are their series in r² = ρ² / t_z²,
with θ^(2n+1) / r^(2n+1) from atan r = r - r³/3 + r⁵/5 - r⁷/7:

    t_z g = 1 + r² (k1 - 1/3) + r⁴ (k2 - k1 + 1/5) + r⁶ (k3 - 5/3 k2 + 14/15 k1 - 1/7) + …

The depth of a splat is its distance from the camera: the lens may see what is behind the plane t_z = 0.
"""

import warp as wp

from .lens import Distortion, mat23

SERIES = wp.constant(0.0025)
"""r² below which the series are used. Their next terms are 1e-10 for g, 1e-8 for h and 1e-5 for the derivative of h,
which counts r² as much."""


@wp.func
def fisheye_point(t: wp.vec3, focal: wp.vec2, center: wp.vec2, size: wp.vec2, distortion: Distortion, limit: float):
    """The point of the image and J; ``size`` and ``limit`` are not used."""
    k1 = distortion[0]
    k2 = distortion[1]
    k3 = distortion[2]
    k4 = distortion[3]
    x = t[0]
    y = t[1]
    z = t[2]
    rho2 = x * x + y * y
    range2 = rho2 + z * z
    g = float(0.0)
    h = float(0.0)
    g_z = float(0.0)
    if z > 0.0 and rho2 < SERIES * z * z:
        rz = 1.0 / z
        r2 = rho2 * rz * rz
        a1 = k1 - 1.0 / 3.0
        a2 = k2 - k1 + 0.2
        a3 = k3 - 5.0 / 3.0 * k2 + 14.0 / 15.0 * k1 - 1.0 / 7.0
        g = rz * (1.0 + r2 * (a1 + r2 * (a2 + r2 * a3)))
        h = rz * rz * rz * (2.0 * a1 + r2 * (4.0 * a2 + r2 * 6.0 * a3))
        g_z = -rz * rz * (1.0 + r2 * (3.0 * a1 + r2 * (5.0 * a2 + r2 * 7.0 * a3)))
    else:
        rho = wp.sqrt(rho2)
        theta = wp.atan2(rho, z)
        s = theta * theta
        bent = theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        slope = 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
        g = bent / rho
        h = (slope * z / range2 - g) / rho2
        g_z = -slope / range2
    point = wp.vec2(focal[0] * g * x + center[0], focal[1] * g * y + center[1])
    jacobian = mat23(
        focal[0] * (g + h * x * x),
        focal[0] * h * x * y,
        focal[0] * g_z * x,
        focal[1] * h * x * y,
        focal[1] * (g + h * y * y),
        focal[1] * g_z * y,
    )
    return point, jacobian
