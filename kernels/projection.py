"""EWA projection of 3D Gaussians to splats (Zwicker et al. 2001; 3DGS Eq. 5; paper Eq. 3) and its backward pass.

With the camera's rotation W and translation, t = W mean + translation, and the point and Jacobian J of its lens and
shutter at t (``shutter``, ``lens_pinhole`` and the other files of this name):

    mean2d = point + offset · (width, height) / 2
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
and what the intrinsics, the distortion and the motion get through the point, J and the depth. Warp derives these, and
v_t, from the shutter.

A Gaussian is culled (radius 0, everything else 0) unless it is beyond the near plane (for a wide lens, farther than
that from the camera, and within the lens' largest angle), at the middle row and at its own, closer than FAR, reaches
ALPHA_MIN, has an opacity of at most 1 before compensation, touches the image and has a finite, invertible 2D
covariance. Every test is phrased so that NaN fails it.
"""

import functools
import math

import warp as wp

from .constants import ALPHA_MIN, FAR, LOW_PASS
from .lens import Distortion, mat23
from .lenses import LENSES, LensKernels
from .quaternion import quaternion_to_rotation, quaternion_to_rotation_bwd, scaled_rotation
from .rows import Splat, is_culled, make_pack_splat, make_unpack_splat
from .shutter import make_load_motion, make_shutter, make_shutter_sum

CAMERA_GRADIENTS = wp.constant(16)
"""Length of a row of ``v_cameras`` without what follows, distortion and motion: v_W by rows, v_translation, v of f_x,
f_y, c_x, c_y."""

LOG_ALPHA_MIN = wp.constant(math.log(ALPHA_MIN))
MAX_EXTENT = wp.constant(1.0e8)
"""Half extent [px] above which a splat is culled: it must fit an int32, and float32 does not resolve such pixels."""


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
def store_camera_gradients(
    v_cameras: wp.array2d[float],
    i: int,
    mean: wp.vec3,
    v_t: wp.vec3,
    v_rotation: wp.mat33,
    v_focal: wp.vec2,
    v_center: wp.vec2,
):
    """The first part of row i of ``v_cameras``; ``v_rotation`` is the part of v_W that does not pass through t."""
    for row in range(3):
        for column in range(3):
            v_cameras[i, 3 * row + column] = v_t[row] * mean[column] + v_rotation[row, column]
        v_cameras[i, 9 + row] = v_t[row]
    for axis in range(2):
        v_cameras[i, 12 + axis] = v_focal[axis]
        v_cameras[i, 14 + axis] = v_center[axis]


@wp.func
def focal_lengths(K: wp.array2d[float]) -> wp.vec2:
    return wp.vec2(K[0, 0], K[1, 1])


@wp.func
def principal_point(K: wp.array2d[float]) -> wp.vec2:
    return wp.vec2(K[0, 2], K[1, 2])


@wp.func
def load_distortion(distortion: wp.array[float]) -> Distortion:
    """Coefficients of the lens; the array may be missing."""
    coefficients = Distortion()
    for k in range(distortion.shape[0]):
        coefficients[k] = distortion[k]
    return coefficients


@functools.cache
def make_project(lens: LensKernels, is_rolling: bool, by_columns: bool) -> wp.Function:
    """Function that projects one Gaussian."""
    shutter, is_wide = make_shutter(lens, is_rolling, by_columns), lens.is_wide
    load_motion = make_load_motion(is_rolling)

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
        distortion: wp.array[float],
        limit: float,
        motion: wp.array[wp.vec3],
        near: float,
        compensate: int,
        screen_offsets: wp.array[wp.vec2],
    ) -> Splat:
        """The splat of Gaussian i; ``screen_offsets`` may be missing (an empty array)."""
        splat = Splat()
        rotation = camera_rotation(viewmat)
        t = rotation * means[i] + camera_translation(viewmat)
        depth = t[2]
        if wp.static(is_wide):
            depth = wp.length(t)
            if not (t[2] >= depth * wp.cos(limit)):  # also right behind, if the limit is π
                return splat
        if not (depth > near and wp.length_sq(t) < FAR * FAR and wp.length_sq(quats[i]) > 0.0):
            return splat
        size = wp.vec2(float(width), float(height))
        turn, move = load_motion(motion)
        mean2d, jacobian, row_depth = shutter(
            t, turn, move, focal_lengths(K), principal_point(K), size, load_distortion(distortion), limit
        )
        if wp.static(is_rolling):
            depth = row_depth
            if not depth > near:
                return splat
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
        if screen_offsets.shape[0] > 0:
            mean2d += wp.cw_mul(0.5 * size, screen_offsets[i])
        if not (
            mean2d[0] + radius_x > 0.0
            and mean2d[0] - radius_x < size[0]
            and mean2d[1] + radius_y > 0.0
            and mean2d[1] - radius_y < size[1]
            and radius_x < MAX_EXTENT
            and radius_y < MAX_EXTENT
        ):
            return splat
        splat.mean = mean2d
        splat.conic = wp.vec3(c / det, -b / det, a / det)
        splat.depth = depth
        splat.opacity = opacity
        splat.radius = wp.vec2i(wp.max(int(radius_x), 1), wp.max(int(radius_y), 1))
        return splat

    return project


@functools.cache
def make_project_fwd(
    num_features: int, with_depth: bool, lens: str = "pinhole", is_rolling: bool = False, by_columns: bool = False
) -> wp.Kernel:
    """Kernel that projects Gaussians and packs them, one thread for each."""
    pack_splat, project = make_pack_splat(num_features, with_depth), make_project(LENSES[lens], is_rolling, by_columns)

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
        distortion: wp.array[float],
        limit: float,
        motion: wp.array[wp.vec3],
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
        splat = project(
            i,
            means,
            quats,
            scales,
            opacities,
            viewmat,
            K,
            width,
            height,
            distortion,
            limit,
            motion,
            near,
            compensate,
            screen_offsets,
        )
        if not pack_splat(i, splat, features, rows, depth_keys, gaussian_from_rank, scan_words, sort_counters):
            splat.radius = wp.vec2i(0, 0)
        radii[i] = splat.radius

    return project_fwd


@functools.cache
def make_project_bwd(
    num_features: int, with_depth: bool, lens: str = "pinhole", is_rolling: bool = False, by_columns: bool = False
) -> wp.Kernel:
    """Kernel that turns gradient rows into the gradients of the Gaussians, one thread for each."""
    unpack_splat = make_unpack_splat(num_features, with_depth)
    shutter_sum, load_motion = make_shutter_sum(LENSES[lens], is_rolling, by_columns), make_load_motion(is_rolling)

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
        distortion: wp.array[float],
        limit: float,
        motion: wp.array[wp.vec3],
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
        focal = focal_lengths(K)
        center = principal_point(K)
        size = wp.vec2(float(width), float(height))
        coefficients = load_distortion(distortion)
        turn, move = load_motion(motion)
        # The gradient by v_jacobian is J. After a plain call of the lens, Warp 1.19 would make no adjoint of it.
        _t, _turn, _move, _focal, _center, _size, _distortion, _limit, _point, jacobian, _depth = wp.grad(shutter_sum)(
            t, turn, move, focal, center, size, coefficients, limit, wp.vec2(0.0), mat23(0.0), 0.0
        )
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
        v_t, v_turn, v_move, v_focal, v_center, _size, v_distortion, _limit, _point, _jacobian, _depth = wp.grad(
            shutter_sum
        )(t, turn, move, focal, center, size, coefficients, limit, v_splat.mean, v_jacobian, v_splat.depth)
        v_means[i] = wp.transpose(rotation) * v_t
        if v_cameras.shape[1] > 0:
            v_rotation = wp.transpose(jacobian) * v_to_image
            store_camera_gradients(v_cameras, i, means[i], v_t, v_rotation, v_focal, v_center)
            for part in range(distortion.shape[0]):
                v_cameras[i, CAMERA_GRADIENTS + part] = v_distortion[part]
            if wp.static(is_rolling):
                after = CAMERA_GRADIENTS + distortion.shape[0]
                for axis in range(3):
                    v_cameras[i, after + axis] = v_turn[axis]
                    v_cameras[i, after + 3 + axis] = v_move[axis]

    return project_bwd
