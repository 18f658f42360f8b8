"""EWA projection of 3D Gaussians to splats (Zwicker et al. 2001; 3DGS Eq. 5; paper Eq. 3) and its backward pass.

With the camera's rotation W and translation, t = W mean + translation, depth z = t_z, u = t_x / z, v = t_y / z:

    mean2d = (f_x u + c_x, f_y v + c_y) + offset · (width, height) / 2
    J      = [[f_x / z, 0, -f_x ū / z], [0, f_y / z, -f_y v̄ / z]],  ū, v̄ = u, v clamped to a margin around the image
    B      = J W R(q) diag(s),   cov2d = B Bᵀ = [[a', b], [b, c']],   a = a' + LOW_PASS, c = c' + LOW_PASS
    conic  = cov2d⁻¹ = [c, -b, a] / det,   det = a c - b²
    compensation = sqrt(det' / det), det' = a' c' - b²   (Mip-Splatting, Eq. 9: opacity of the unblurred splat)

Σ itself is never formed: cov2d = B Bᵀ is positive semidefinite by construction.

Gradient: with the rows B_0, B_1 of B and n = B_0 × B_1, det' = n² and det = det' + LOW_PASS (a' + c' + LOW_PASS). So,
for gradients v_A, v_B, v_C of the conic's entries
    v_det = -(v_A c - v_B b + v_C a) / det²,  v_a = v_C / det + LOW_PASS v_det,  v_c = v_A / det + LOW_PASS v_det,
    v_b = -v_B / det,  v_n = 2 v_det n,
    v_B0 = 2 v_a B_0 + v_b B_1 + B_1 × v_n,  v_B1 = v_b B_0 + 2 v_c B_1 + v_n × B_0
and v_M = (J W)ᵀ v_B, v_(JW) = v_B Mᵀ. The usual form, v_cov2d = -conic v_conic conic, cancels with the fourth power of
a splat's elongation: at 200:1 it leaves nothing of the gradient of the length in single precision. Here n, the cross
product of scaled axes, cancels little.
Through t, with v_t: v_mean = Wᵀ v_t, and for the camera the sums over all Gaussians of
    v_W = v_t meanᵀ + Jᵀ v_(JW),  v_translation = v_t
and what f_x, f_y, c_x, c_y get through mean2d, J and, where ū or v̄ is clamped, through the margin of the image.

A Gaussian is culled (radius 0, everything else 0) unless it is beyond the near plane, closer than FAR, reaches
ALPHA_MIN, has an opacity of at most 1 before compensation, touches the image and has a finite, invertible 2D
covariance. Every test is phrased so that NaN fails it.
"""

import functools
import math

import warp as wp

from .constants import ALPHA_MIN, FAR, FIELD_OF_VIEW_MARGIN, LOW_PASS
from .quaternion import quaternion_to_rotation, quaternion_to_rotation_bwd, scaled_rotation
from .rows import Splat, is_culled, make_pack_splat, make_unpack_splat

CAMERA_GRADIENTS = 16
"""Length of a row of ``v_cameras``: v_W by rows, v_translation, v of f_x, f_y, c_x, c_y."""

mat23 = wp.types.matrix(shape=(2, 3), dtype=float)

LOG_ALPHA_MIN = wp.constant(math.log(ALPHA_MIN))
MAX_EXTENT = wp.constant(1.0e8)
"""Half extent [px] above which a splat is culled: it must fit an int32, and float32 does not resolve such pixels."""


@wp.func
def clamped_slope(slope: float, size: float, focal: float, center: float) -> float:
    """x / z, clamped to FIELD_OF_VIEW_MARGIN around the image, beyond which the local affine approximation fails."""
    margin = FIELD_OF_VIEW_MARGIN * 0.5 * size / focal
    return wp.clamp(slope, -center / focal - margin, (size - center) / focal + margin)


@wp.func
def camera_rotation(viewmat: wp.array2d[float]) -> wp.mat33:
    return wp.mat33(
        viewmat[0, 0],
        viewmat[0, 1],
        viewmat[0, 2],
        viewmat[1, 0],
        viewmat[1, 1],
        viewmat[1, 2],
        viewmat[2, 0],
        viewmat[2, 1],
        viewmat[2, 2],
    )


@wp.func
def camera_translation(viewmat: wp.array2d[float]) -> wp.vec3:
    return wp.vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
def projection_jacobian(t: wp.vec3, fx: float, fy: float, u: float, v: float) -> mat23:
    """J at camera-space point t, with the clamped slopes u and v."""
    rz = 1.0 / t[2]
    return mat23(fx * rz, 0.0, -fx * u * rz, 0.0, fy * rz, -fy * v * rz)


@wp.func
def store_camera_gradients(
    v_cameras: wp.array2d[float],
    i: int,
    mean: wp.vec3,
    v_t: wp.vec3,
    v_rotation: wp.mat33,
    v_intrinsics: wp.vec4,
):
    """Row i of ``v_cameras``; ``v_rotation`` is the part of v_W that does not pass through t."""
    for row in range(3):
        for column in range(3):
            v_cameras[i, 3 * row + column] = v_t[row] * mean[column] + v_rotation[row, column]
        v_cameras[i, 9 + row] = v_t[row]
    for part in range(4):
        v_cameras[i, 12 + part] = v_intrinsics[part]


@wp.func
def project(
    i: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    viewmat: wp.array2d[float],
    K: wp.array2d[float],
    width: int,
    height: int,
    near: float,
    compensate: int,
    screen_offsets: wp.array[wp.vec2],
) -> Splat:
    """The splat of Gaussian i; ``screen_offsets`` may be missing (an empty array)."""
    splat = Splat()
    rotation = camera_rotation(viewmat)
    t = rotation * means[i] + camera_translation(viewmat)
    if not (t[2] > near and wp.length_sq(t) < FAR * FAR and wp.length_sq(quats[i]) > 0.0):
        return splat
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    u = t[0] / t[2]
    v = t[1] / t[2]
    jacobian = projection_jacobian(
        t, fx, fy, clamped_slope(u, float(width), fx, cx), clamped_slope(v, float(height), fy, cy)
    )
    spread = (jacobian * rotation) * scaled_rotation(quats[i], scales[i])
    a_sharp = wp.dot(spread[0], spread[0])
    b = wp.dot(spread[0], spread[1])
    c_sharp = wp.dot(spread[1], spread[1])
    a = a_sharp + LOW_PASS
    c = c_sharp + LOW_PASS
    # a c - b² in a form that cancels less: both Gram determinants are sums of squares.
    det_sharp = wp.length_sq(wp.cross(spread[0], spread[1]))
    det = det_sharp + LOW_PASS * (a_sharp + c_sharp + LOW_PASS)
    opacity = opacities[i]
    if compensate != 0:
        opacity = opacity * wp.sqrt(det_sharp / det)
    if not (opacity >= wp.static(ALPHA_MIN) and opacities[i] <= 1.0):
        return splat
    reach = wp.sqrt(2.0 * (wp.log(opacity) - LOG_ALPHA_MIN))
    radius_x = wp.ceil(reach * wp.sqrt(a))
    radius_y = wp.ceil(reach * wp.sqrt(c))
    mean2d = wp.vec2(fx * u + cx, fy * v + cy)
    if screen_offsets.shape[0] > 0:
        offset = screen_offsets[i]
        mean2d += wp.vec2(0.5 * float(width) * offset[0], 0.5 * float(height) * offset[1])
    if not (
        mean2d[0] + radius_x > 0.0
        and mean2d[0] - radius_x < float(width)
        and mean2d[1] + radius_y > 0.0
        and mean2d[1] - radius_y < float(height)
        and radius_x < MAX_EXTENT
        and radius_y < MAX_EXTENT
    ):
        return splat
    splat.mean = mean2d
    splat.conic = wp.vec3(c / det, -b / det, a / det)
    splat.depth = t[2]
    splat.opacity = opacity
    splat.radius = wp.vec2i(wp.max(int(radius_x), 1), wp.max(int(radius_y), 1))
    return splat


@functools.cache
def make_project_fwd(num_features: int, with_depth: bool) -> wp.Kernel:
    """Kernel that projects Gaussians and packs them, one thread for each."""
    pack_splat = make_pack_splat(num_features, with_depth)

    @wp.kernel(enable_backward=False, module="unique")
    def project_fwd(
        first: int,
        means: wp.array[wp.vec3],
        quats: wp.array[wp.vec4],
        scales: wp.array[wp.vec3],
        opacities: wp.array[float],
        viewmat: wp.array2d[float],
        K: wp.array2d[float],
        width: int,
        height: int,
        near: float,
        compensate: int,
        screen_offsets: wp.array[wp.vec2],
        features: wp.array2d[float],
        radii: wp.array[wp.vec2i],
        rows: wp.array2d[wp.vec4],
        depth_keys: wp.array[int],
        gaussian_from_rank: wp.array[int],
        scan_words: wp.array[wp.int64],
        sort_counters: wp.array[int],
    ):
        i = first + wp.tid()
        splat = project(i, means, quats, scales, opacities, viewmat, K, width, height, near, compensate, screen_offsets)
        if not pack_splat(i, splat, features, rows, depth_keys, gaussian_from_rank, scan_words, sort_counters):
            splat.radius = wp.vec2i(0, 0)
        radii[i] = splat.radius

    return project_fwd


@functools.cache
def make_project_bwd(num_features: int, with_depth: bool) -> wp.Kernel:
    """Kernel that turns gradient rows into the gradients of the Gaussians, one thread for each."""
    unpack_splat = make_unpack_splat(num_features, with_depth)

    @wp.kernel(enable_backward=False, module="unique")
    def project_bwd(
        first: int,
        means: wp.array[wp.vec3],
        quats: wp.array[wp.vec4],
        scales: wp.array[wp.vec3],
        opacities: wp.array[float],
        viewmat: wp.array2d[float],
        K: wp.array2d[float],
        width: int,
        height: int,
        compensate: int,
        rows: wp.array2d[wp.vec4],
        gradients: wp.array2d[wp.vec4],
        absgrad: int,
        v_features: wp.array2d[float],
        v_screen_offsets: wp.array[wp.vec2],
        v_means: wp.array[wp.vec3],
        v_quats: wp.array[wp.vec4],
        v_scales: wp.array[wp.vec3],
        v_opacities: wp.array[float],
        v_cameras: wp.array2d[float],
    ):
        i = first + wp.tid()
        v_splat = unpack_splat(i, rows, gradients, width, height, absgrad, v_features, v_screen_offsets)
        if is_culled(rows, i):
            for part in range(v_cameras.shape[1]):
                v_cameras[i, part] = 0.0
            v_means[i] = wp.vec3(0.0)
            v_quats[i] = wp.vec4(0.0)
            v_scales[i] = wp.vec3(0.0)
            v_opacities[i] = 0.0
            return
        rotation = camera_rotation(viewmat)
        t = rotation * means[i] + camera_translation(viewmat)
        fx = K[0, 0]
        fy = K[1, 1]
        rz = 1.0 / t[2]
        slope_u = t[0] * rz
        slope_v = t[1] * rz
        u = clamped_slope(slope_u, float(width), fx, K[0, 2])
        v = clamped_slope(slope_v, float(height), fy, K[1, 2])
        jacobian = projection_jacobian(t, fx, fy, u, v)
        to_image = jacobian * rotation
        q = quats[i]
        s = scales[i]
        orientation = quaternion_to_rotation(q)
        shape = orientation * wp.diag(s)
        spread = to_image * shape

        a_sharp = wp.dot(spread[0], spread[0])
        b = wp.dot(spread[0], spread[1])
        c_sharp = wp.dot(spread[1], spread[1])
        normal = wp.cross(spread[0], spread[1])
        det_sharp = wp.length_sq(normal)
        det = det_sharp + LOW_PASS * (a_sharp + c_sharp + LOW_PASS)
        v_conic = v_splat.conic / det
        v_det = -(v_conic[0] * (c_sharp + LOW_PASS) - v_conic[1] * b + v_conic[2] * (a_sharp + LOW_PASS)) / det
        v_det_sharp = float(0.0)  # in addition to v_det
        v_opacity = float(v_splat.opacity)
        if compensate != 0:
            compensation = wp.sqrt(det_sharp / det)
            # d compensation = (d det' - compensation² d det) / (2 compensation det); visible splats have at least
            # ALPHA_MIN of it.
            v_det_sharp = v_opacity * opacities[i] * 0.5 / (compensation * det)
            v_det -= v_det_sharp * compensation * compensation
            v_opacity = v_opacity * compensation
        v_opacities[i] = v_opacity
        v_a = v_conic[2] + LOW_PASS * v_det
        v_b = -v_conic[1]
        v_c = v_conic[0] + LOW_PASS * v_det
        v_normal = 2.0 * (v_det + v_det_sharp) * normal
        v_row0 = 2.0 * v_a * spread[0] + v_b * spread[1] + wp.cross(spread[1], v_normal)
        v_row1 = v_b * spread[0] + 2.0 * v_c * spread[1] + wp.cross(v_normal, spread[0])
        v_spread = mat23(v_row0[0], v_row0[1], v_row0[2], v_row1[0], v_row1[1], v_row1[2])
        v_shape = wp.transpose(to_image) * v_spread
        v_scales[i] = wp.vec3(
            orientation[0, 0] * v_shape[0, 0] + orientation[1, 0] * v_shape[1, 0] + orientation[2, 0] * v_shape[2, 0],
            orientation[0, 1] * v_shape[0, 1] + orientation[1, 1] * v_shape[1, 1] + orientation[2, 1] * v_shape[2, 1],
            orientation[0, 2] * v_shape[0, 2] + orientation[1, 2] * v_shape[1, 2] + orientation[2, 2] * v_shape[2, 2],
        )
        v_quats[i] = quaternion_to_rotation_bwd(q, v_shape * wp.diag(s))

        v_to_image = v_spread * wp.transpose(shape)
        v_jacobian = v_to_image * wp.transpose(rotation)
        v_mean2d = v_splat.mean
        # The centre depends on the slope t_x / z itself, the Jacobian on the clamped slope, constant where clamped.
        v_u = fx * v_mean2d[0]
        v_v = fy * v_mean2d[1]
        if u == slope_u:
            v_u -= fx * rz * v_jacobian[0, 2]
        if v == slope_v:
            v_v -= fy * rz * v_jacobian[1, 2]
        v_z = -rz * (
            jacobian[0, 0] * v_jacobian[0, 0]
            + jacobian[0, 2] * v_jacobian[0, 2]
            + jacobian[1, 1] * v_jacobian[1, 1]
            + jacobian[1, 2] * v_jacobian[1, 2]
        )
        v_z += v_splat.depth
        v_t = wp.vec3(rz * v_u, rz * v_v, v_z - rz * (slope_u * v_u + slope_v * v_v))
        v_means[i] = wp.transpose(rotation) * v_t
        if v_cameras.shape[1] > 0:
            v_fx = slope_u * v_mean2d[0] + rz * (v_jacobian[0, 0] - u * v_jacobian[0, 2])
            v_fy = slope_v * v_mean2d[1] + rz * (v_jacobian[1, 1] - v * v_jacobian[1, 2])
            v_cx = v_mean2d[0]
            v_cy = v_mean2d[1]
            # A clamped slope is (constant - c) / f.
            if u != slope_u:
                v_fx += rz * u * v_jacobian[0, 2]
                v_cx += rz * v_jacobian[0, 2]
            if v != slope_v:
                v_fy += rz * v * v_jacobian[1, 2]
                v_cy += rz * v_jacobian[1, 2]
            v_rotation = wp.transpose(jacobian) * v_to_image
            store_camera_gradients(v_cameras, i, means[i], v_t, v_rotation, wp.vec4(v_fx, v_fy, v_cx, v_cy))

    return project_bwd
