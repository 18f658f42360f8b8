"""Rotation matrices of quaternions (w, x, y, z), which are normalised here.

    R = [[1-2(y²+z²), 2(xy-wz), 2(xz+wy)], [2(xy+wz), 1-2(x²+z²), 2(yz-wx)], [2(xz-wy), 2(yz+wx), 1-2(x²+y²)]]

for the components of q̂ = q / |q|. Gradient: v_q̂ from the derivatives of the nine entries, then
v_q = (v_q̂ - q̂ (q̂ · v_q̂)) / |q|.
"""

import warp as wp


@wp.func
def quaternion_to_rotation(q: wp.vec4) -> wp.mat33:
    """Rotation matrix of q / |q|; q must not be zero."""
    n = q / wp.length(q)
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def scaled_rotation(q: wp.vec4, s: wp.vec3) -> wp.mat33:
    """M = R(q) diag(s), so that the covariance is M Mᵀ (3DGS, Eq. 6)."""
    return quaternion_to_rotation(q) * wp.diag(s)


@wp.func
def quaternion_to_rotation_bwd(q: wp.vec4, v: wp.mat33) -> wp.vec4:
    """Gradient of the quaternion from the gradient ``v`` of its rotation matrix."""
    inverse_length = 1.0 / wp.length(q)
    n = q * inverse_length
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    v_n = 2.0 * wp.vec4(
        x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]),
        -2.0 * x * (v[1, 1] + v[2, 2]) + y * (v[0, 1] + v[1, 0]) + z * (v[0, 2] + v[2, 0]) + w * (v[2, 1] - v[1, 2]),
        x * (v[0, 1] + v[1, 0]) - 2.0 * y * (v[0, 0] + v[2, 2]) + z * (v[1, 2] + v[2, 1]) + w * (v[0, 2] - v[2, 0]),
        x * (v[0, 2] + v[2, 0]) + y * (v[1, 2] + v[2, 1]) - 2.0 * z * (v[0, 0] + v[1, 1]) + w * (v[1, 0] - v[0, 1]),
    )
    return (v_n - n * wp.dot(n, v_n)) * inverse_length
