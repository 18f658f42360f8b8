"""OpenCV's lens with radial, tangential, rational and thin-prism terms (COLMAP's OPENCV and FULL_OPENCV).

With x, y = t_x / t_z, t_y / t_z, r² = x² + y² and the coefficients k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, in
OpenCV's order:

    d  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    f  = (x d + 2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴,  y d + p1 (r² + 2 y²) + 2 p2 x y + s3 r² + s4 r⁴)
    point = focal · f + center

Such polynomials fold back far from the axis. So q = (x, y) is cut to a radius, ``limit``, beyond the corners of the
image, and farther away f continues linearly, f(q) + Df(q) ((x, y) - q), with the Jacobian of q:

    J = diag(focal) Df(q) [[1 / t_z, 0, -q_x / t_z], [0, 1 / t_z, -q_y / t_z]]
"""

import warp as wp

from .lens import Distortion, mat23


@wp.func
def radial_point(t: wp.vec3, focal: wp.vec2, center: wp.vec2, size: wp.vec2, distortion: Distortion, limit: float):
    """The point of the image and J; ``limit`` is the radius on the plane z = 1 up to which the formula holds."""
    k1 = distortion[0]
    k2 = distortion[1]
    p1 = distortion[2]
    p2 = distortion[3]
    rz = 1.0 / t[2]
    slope = wp.vec2(t[0] * rz, t[1] * rz)
    q = slope
    if wp.length_sq(slope) > limit * limit:
        q = slope * (limit / wp.length(slope))
    x = q[0]
    y = q[1]
    r2 = x * x + y * y
    numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * distortion[4]))
    denominator = 1.0 + r2 * (distortion[5] + r2 * (distortion[6] + r2 * distortion[7]))
    d = numerator / denominator
    # The derivative of d by r².
    slope_numerator = k1 + r2 * (2.0 * k2 + r2 * 3.0 * distortion[4])
    slope_denominator = distortion[5] + r2 * (2.0 * distortion[6] + r2 * 3.0 * distortion[7])
    d_r2 = (slope_numerator - d * slope_denominator) / denominator
    prism_x = r2 * (distortion[8] + r2 * distortion[9])
    prism_y = r2 * (distortion[10] + r2 * distortion[11])
    prism_x_r2 = distortion[8] + 2.0 * r2 * distortion[9]
    prism_y_r2 = distortion[10] + 2.0 * r2 * distortion[11]
    image_x = x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + prism_x
    image_y = y * d + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + prism_y
    xx = focal[0] * (d + 2.0 * x * x * d_r2 + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x_r2)
    xy = focal[0] * (2.0 * x * y * d_r2 + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * y * prism_x_r2)
    yx = focal[1] * (2.0 * x * y * d_r2 + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * x * prism_y_r2)
    yy = focal[1] * (d + 2.0 * y * y * d_r2 + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y_r2)
    beyond = slope - q
    point = wp.vec2(
        focal[0] * image_x + center[0] + xx * beyond[0] + xy * beyond[1],
        focal[1] * image_y + center[1] + yx * beyond[0] + yy * beyond[1],
    )
    jacobian = mat23(xx * rz, xy * rz, -(xx * x + xy * y) * rz, yx * rz, yy * rz, -(yx * x + yy * y) * rz)
    return point, jacobian
