"""Activation of raw Gaussians with the outputs of the two networks applied (paper Eq. 8, 10, 11).

For each Gaussian, with offsets δμ, δr, δs from the deformation network and residuals from the appearance network, if
there are any:

    mean = μ + δμ,   quat = (1 + δr) · q,   scale = exp(log s + δs),   opacity = σ(logit + Δlogit),   sh = w⁰ + Δw

So A Σ Aᵀ = A R S² Rᵀ Aᵀ with A = R(1 + δr) · R exp(δs) Rᵀ: the rotation offset is multiplied from the left (Hamilton
product of quaternions (w, x, y, z)), the scale offset is added to the log-scales.

Gradient: v_μ = v_δμ = v_mean; v_δs = v_log_s = v_scale · scale; v_logit = v_opacity · o (1 − o); for a product
q = a b of quaternions, v_a = v_q b* and v_b = a* v_q, where * is the conjugate.
"""

import warp as wp

IDENTITY = wp.constant(wp.vec4(1.0, 0.0, 0.0, 0.0))


@wp.func
def product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Hamilton product of quaternions (w, x, y, z): the rotation b followed by the rotation a."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def conjugate(a: wp.vec4) -> wp.vec4:
    return wp.vec4(a[0], -a[1], -a[2], -a[3])


@wp.func
def rotation_offset(offsets: wp.array2d[float], i: int) -> wp.vec4:
    """The quaternion 1 + δr of Gaussian ``i``."""
    return IDENTITY + wp.vec4(offsets[i, 3], offsets[i, 4], offsets[i, 5], offsets[i, 6])


@wp.kernel(enable_backward=False)
def activate_fwd(
    first: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    logit_opacities: wp.array[float],
    offsets: wp.array2d[float],
    logit_residuals: wp.array[float],
    first_row: int,
    out_means: wp.array[wp.vec3],
    out_quats: wp.array[wp.vec4],
    out_scales: wp.array[wp.vec3],
    out_opacities: wp.array[float],
):
    i = first + wp.tid()
    row = first_row + i
    mean = means[i]
    quat = quats[i]
    log_scale = log_scales[i]
    logit = logit_opacities[i]
    if offsets.shape[0] > 0:
        mean += wp.vec3(offsets[i, 0], offsets[i, 1], offsets[i, 2])
        quat = product(rotation_offset(offsets, i), quat)
        log_scale += wp.vec3(offsets[i, 7], offsets[i, 8], offsets[i, 9])
    if logit_residuals.shape[0] > 0:
        logit += logit_residuals[i]
    out_means[row] = mean
    out_quats[row] = quat
    out_scales[row] = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
    out_opacities[row] = 1.0 / (1.0 + wp.exp(-logit))


@wp.kernel(enable_backward=False)
def activate_bwd(
    first: int,
    quats: wp.array[wp.vec4],
    offsets: wp.array2d[float],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    v_out_means: wp.array[wp.vec3],
    v_out_quats: wp.array[wp.vec4],
    v_out_scales: wp.array[wp.vec3],
    v_out_opacities: wp.array[float],
    first_row: int,
    v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4],
    v_log_scales: wp.array[wp.vec3],
    v_logits: wp.array[float],
    v_offsets: wp.array2d[float],
):
    i = first + wp.tid()
    row = first_row + i
    v_mean = v_out_means[row]
    v_quat = v_out_quats[row]
    v_log_scale = wp.cw_mul(v_out_scales[row], scales[row])
    opacity = opacities[row]
    v_means[i] = v_mean
    v_log_scales[i] = v_log_scale
    v_logits[i] = v_out_opacities[row] * opacity * (1.0 - opacity)
    if offsets.shape[0] > 0:
        v_rotation = product(v_quat, conjugate(quats[i]))
        for k in range(3):
            v_offsets[i, k] = v_mean[k]
            v_offsets[i, 7 + k] = v_log_scale[k]
        for k in range(4):
            v_offsets[i, 3 + k] = v_rotation[k]
        v_quat = product(conjugate(rotation_offset(offsets, i)), v_quat)
    v_quats[i] = v_quat


@wp.kernel(enable_backward=False)
def join_sh_fwd(
    first: int,
    sh_dc: wp.array2d[wp.vec3],
    sh_rest: wp.array2d[wp.vec3],
    residuals: wp.array2d[wp.vec3],
    first_row: int,
    sh: wp.array2d[wp.vec3],
):
    """One thread for each Gaussian and basis, which writes that coefficient of all three colours."""
    thread = first + wp.tid()
    bases = sh.shape[1]
    i = thread // bases
    k = thread - i * bases
    value = wp.vec3(0.0)
    if k == 0:
        value = sh_dc[i, 0]
    else:
        value = sh_rest[i, k - 1]
    if residuals.shape[0] > 0 and k < residuals.shape[1]:
        value += residuals[i, k]
    sh[first_row + i, k] = value


@wp.kernel(enable_backward=False)
def join_sh_bwd(
    first: int,
    v_sh: wp.array2d[wp.vec3],
    first_row: int,
    v_sh_dc: wp.array2d[wp.vec3],
    v_sh_rest: wp.array2d[wp.vec3],
    v_residuals: wp.array2d[wp.vec3],
):
    thread = first + wp.tid()
    bases = v_sh.shape[1]
    i = thread // bases
    k = thread - i * bases
    value = v_sh[first_row + i, k]
    if k == 0:
        v_sh_dc[i, 0] = value
    else:
        v_sh_rest[i, k - 1] = value
    if v_residuals.shape[0] > 0 and k < v_residuals.shape[1]:
        v_residuals[i, k] = value
