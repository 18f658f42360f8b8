"""Real spherical harmonics of degree 0 to 3 as view-dependent colour (3DGS; basis and signs of Sloan 2008).

    colour = max(0, ½ + Σ_k Y_k(d) coefficient_k),   d = (mean - viewpoint) / |mean - viewpoint|

Gradient: v_coefficient_k = Y_k(d) v, and through the direction v_d = Σ_k ∇Y_k(d) (coefficient_k · v),
v_mean = (v_d - d (d · v_d)) / |mean - viewpoint|. Where max(0, ·) clamps, v is zero.
"""

import math

import warp as wp

from .lanes import native

C0 = wp.constant(0.5 * math.sqrt(1.0 / math.pi))
C1 = wp.constant(0.5 * math.sqrt(3.0 / math.pi))
C2_XY = wp.constant(0.5 * math.sqrt(15.0 / math.pi))
C2_Z2 = wp.constant(0.25 * math.sqrt(5.0 / math.pi))
C2_X2 = wp.constant(0.25 * math.sqrt(15.0 / math.pi))
C3_M3 = wp.constant(0.25 * math.sqrt(35.0 / (2.0 * math.pi)))
C3_M2 = wp.constant(0.5 * math.sqrt(105.0 / math.pi))
C3_M1 = wp.constant(0.25 * math.sqrt(21.0 / (2.0 * math.pi)))
C3_0 = wp.constant(0.25 * math.sqrt(7.0 / math.pi))
C3_P2 = wp.constant(0.25 * math.sqrt(105.0 / math.pi))

NUM_BASES = 16
bases_vector = wp.types.vector(length=NUM_BASES, dtype=float)
mat43 = wp.types.matrix(shape=(4, 3), dtype=float)


@wp.func
def sh_bases(d: wp.vec3) -> bases_vector:
    """Y_0 … Y_15 for a direction d of length 1."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    return bases_vector(
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2_XY * x * y,
        -C2_XY * y * z,
        C2_Z2 * (2.0 * zz - xx - yy),
        -C2_XY * x * z,
        C2_X2 * (xx - yy),
        -C3_M3 * y * (3.0 * xx - yy),
        C3_M2 * x * y * z,
        -C3_M1 * y * (4.0 * zz - xx - yy),
        C3_0 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -C3_M1 * x * (4.0 * zz - xx - yy),
        C3_P2 * z * (xx - yy),
        -C3_M3 * x * (xx - 3.0 * yy),
    )


@wp.func
def sh_direction_bwd(d: wp.vec3, v: bases_vector) -> wp.vec3:
    """Σ_k v_k ∇Y_k(d), with the polynomials above extended to all of space."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    v_x = -C1 * v[3] + C2_XY * (y * v[4] - z * v[7]) - 2.0 * C2_Z2 * x * v[6] + 2.0 * C2_X2 * x * v[8]
    v_x += -6.0 * C3_M3 * x * y * v[9] + C3_M2 * y * z * v[10] + 2.0 * C3_M1 * x * y * v[11]
    v_x += -6.0 * C3_0 * x * z * v[12] - C3_M1 * (4.0 * zz - 3.0 * xx - yy) * v[13] + 2.0 * C3_P2 * x * z * v[14]
    v_x += -3.0 * C3_M3 * (xx - yy) * v[15]
    v_y = -C1 * v[1] + C2_XY * (x * v[4] - z * v[5]) - 2.0 * C2_Z2 * y * v[6] - 2.0 * C2_X2 * y * v[8]
    v_y += -3.0 * C3_M3 * (xx - yy) * v[9] + C3_M2 * x * z * v[10] - C3_M1 * (4.0 * zz - xx - 3.0 * yy) * v[11]
    v_y += -6.0 * C3_0 * y * z * v[12] + 2.0 * C3_M1 * x * y * v[13] - 2.0 * C3_P2 * y * z * v[14]
    v_y += 6.0 * C3_M3 * x * y * v[15]
    v_z = C1 * v[2] - C2_XY * (y * v[5] + x * v[7]) + 4.0 * C2_Z2 * z * v[6]
    v_z += C3_M2 * x * y * v[10] - 8.0 * C3_M1 * z * (y * v[11] + x * v[13])
    v_z += 3.0 * C3_0 * (2.0 * zz - xx - yy) * v[12] + C3_P2 * (xx - yy) * v[14]
    return wp.vec3(v_x, v_y, v_z)


@wp.func
def viewpoint(viewmat: wp.array2d[float]) -> wp.vec3:
    """Camera centre -Wᵀ translation of a world-to-camera matrix."""
    return -wp.vec3(
        viewmat[0, 0] * viewmat[0, 3] + viewmat[1, 0] * viewmat[1, 3] + viewmat[2, 0] * viewmat[2, 3],
        viewmat[0, 1] * viewmat[0, 3] + viewmat[1, 1] * viewmat[1, 3] + viewmat[2, 1] * viewmat[2, 3],
        viewmat[0, 2] * viewmat[0, 3] + viewmat[1, 2] * viewmat[1, 3] + viewmat[2, 2] * viewmat[2, 3],
    )


@wp.func
def direction_from(mean: wp.vec3, origin: wp.vec3) -> wp.vec3:
    """Unit vector from origin to mean; zero, not NaN, where they coincide."""
    offset = mean - origin
    length = wp.length(offset)
    if length > 0.0:
        return offset / length
    return wp.vec3(0.0)


# Coefficients of one Gaussian are far from those of the next, so that every instruction of a warp that accesses one
# number touches 32 sectors of memory. Where those of all Gaussians begin at multiples of 16 bytes (``in_fours`` is 1 on
# CUDA), four of them are three pieces of 16 bytes.
@wp.func_native(
    native(
        """
        const float4* pieces = (const float4*)&wp::index(coefficients, i, first);
        wp::mat_t<4, 3, float> four;
        float* v = &four.data[0][0];
        for (int k = 0; k < 3; ++k) {
            const float4 p = pieces[k];
            v[4 * k] = p.x; v[4 * k + 1] = p.y; v[4 * k + 2] = p.z; v[4 * k + 3] = p.w;
        }
        return four;
        """,
        """
        wp::mat_t<4, 3, float> four;
        for (int k = 0; k < 4; ++k)
            for (int c = 0; c < 3; ++c) four.data[k][c] = wp::index(coefficients, i, first + k)[c];
        return four;
        """,
    )
)
def load_four(coefficients: wp.array2d[wp.vec3], i: int, first: int) -> mat43: ...


@wp.func_native(
    native(
        """
        float4* pieces = (float4*)&wp::index(coefficients, i, first);
        const float* v = &four.data[0][0];
        for (int k = 0; k < 3; ++k) pieces[k] = make_float4(v[4 * k], v[4 * k + 1], v[4 * k + 2], v[4 * k + 3]);
        """,
        """
        for (int k = 0; k < 4; ++k)
            for (int c = 0; c < 3; ++c) wp::index(coefficients, i, first + k)[c] = four.data[k][c];
        """,
    )
)
def store_four(coefficients: wp.array2d[wp.vec3], i: int, first: int, four: mat43): ...


@wp.kernel(enable_backward=False)
def sh_fwd(
    first: int,
    means: wp.array[wp.vec3],
    coefficients: wp.array2d[wp.vec3],
    viewmat: wp.array2d[float],
    num_bases: int,
    in_fours: int,
    colors: wp.array[wp.vec3],
):
    i = first + wp.tid()
    bases = sh_bases(direction_from(means[i], viewpoint(viewmat)))
    color = wp.vec3(0.5)
    if in_fours != 0:
        for group in range(NUM_BASES // 4):
            if 4 * group < num_bases:
                four = load_four(coefficients, i, 4 * group)
                for part in range(4):
                    if 4 * group + part < num_bases:
                        color += bases[4 * group + part] * four[part]
    else:
        for k in range(NUM_BASES):
            if k < num_bases:
                color += bases[k] * coefficients[i, k]
    if wp.isfinite(color[0] + color[1] + color[2]):
        color = wp.max(color, wp.vec3(0.0))
    else:
        color = wp.vec3(wp.nan)  # so that the Gaussian is culled instead of turning black
    colors[i] = color


@wp.kernel(enable_backward=False)
def sh_bwd(
    first: int,
    means: wp.array[wp.vec3],
    coefficients: wp.array2d[wp.vec3],
    viewmat: wp.array2d[float],
    num_bases: int,
    in_fours: int,
    colors: wp.array[wp.vec3],
    v_colors: wp.array[wp.vec3],
    v_means: wp.array[wp.vec3],
    v_coefficients: wp.array2d[wp.vec3],
    v_viewpoints: wp.array[wp.vec3],
):
    """Adds to ``v_means``. ``v_viewpoints``, what each Gaussian contributes to that of the camera, may be missing."""
    i = first + wp.tid()
    total = coefficients.shape[1]
    v = v_colors[i]
    for c in range(3):
        if not (colors[i][c] > 0.0):
            v[c] = 0.0
    # Culled Gaussians, which may have values that are not finite, have no gradient.
    used = int(0)
    origin = viewpoint(viewmat)
    d = direction_from(means[i], origin)
    bases = bases_vector()
    v_bases = bases_vector()
    if v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0:
        used = num_bases
        bases = sh_bases(d)
    if in_fours != 0:
        for group in range(NUM_BASES // 4):
            if 4 * group < total:
                v_four = mat43()
                if 4 * group < used:
                    four = load_four(coefficients, i, 4 * group)
                    for part in range(4):
                        if 4 * group + part < used:
                            v_four[part] = bases[4 * group + part] * v
                            v_bases[4 * group + part] = wp.dot(four[part], v)
                store_four(v_coefficients, i, 4 * group, v_four)
    else:
        for k in range(NUM_BASES):
            if k < used:
                v_coefficients[i, k] = bases[k] * v
                v_bases[k] = wp.dot(coefficients[i, k], v)
            elif k < total:
                v_coefficients[i, k] = wp.vec3(0.0)
    v_mean = wp.vec3(0.0)
    distance = wp.length(means[i] - origin)
    if used > 0 and distance > 0.0:
        v_d = sh_direction_bwd(d, v_bases)
        v_mean = (v_d - d * wp.dot(d, v_d)) / distance
        v_means[i] = v_means[i] + v_mean  # += would be atomic
    if v_viewpoints.shape[0] > 0:
        v_viewpoints[i] = -v_mean
