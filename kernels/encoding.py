"""Sinusoidal encoding of positions and time (paper Eq. 6).

    γ(p) = (p, sin(2⁰ π p) … sin(2ᴸ⁻¹ π p), cos(2⁰ π p) … cos(2ᴸ⁻¹ π p)) with p = (mean - center) / half_size

Columns: the D values, then D L sines, a value's frequencies together, then the cosines in the same order; D is 3 for
positions, then 1 for time. Whole periods are taken off 2ᵏ p before π comes in, and both are exact: every frequency is
as precise as the first. It has no adjoint: positions get no gradient from the networks, as in Deformable-3DGS, and time
is given.
"""

import functools
import math

import warp as wp

CUDA_LANES_LOG2 = 3
"""Logarithm of the number of threads that share the frequencies of a value on CUDA."""


@functools.cache
def make_encode(half: bool) -> wp.Kernel:
    """Kernel that writes the columns of x, y, z or t of a row, in half or single precision.

    2^``lanes_log2`` threads share them, a frequency each: neighbours on CUDA, where they write what lies side by side,
    one thread on CPU. The angles are in [-π, π], where CUDA's fast sine is right to 2⁻²¹: plenty for half precision.
    """
    number = wp.float16 if half else wp.float32

    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": half})
    def encode(
        first: int,
        means: wp.array2d[float],
        time: wp.array[float],
        center: wp.array[float],
        half_size: wp.array[float],
        position_bands: int,
        time_bands: int,
        room: int,
        lanes_log2: int,
        encoding: wp.array2d[number],
    ):
        thread = first + wp.tid()
        lanes = 1 << lanes_log2
        lane = thread & (lanes - 1)
        row = thread >> (lanes_log2 + 2)
        axis = (thread >> lanes_log2) & 3
        dims = 3
        bands = position_bands
        begin = room
        p = time[0]
        if axis < 3:
            p = (means[row, axis] - center[axis]) / half_size[axis]
        else:
            axis = 0
            dims = 1
            bands = time_bands
            begin = room + 3 + 6 * position_bands
            for column in range(begin + 1 + 2 * bands + lane, encoding.shape[1], lanes):
                encoding[row, column] = number(0.0)
        if lane == 0:
            encoding[row, begin + axis] = number(p)
        column = begin + dims + axis * bands
        p *= float(1 << lane)
        for band in range(lane, bands, lanes):
            angle = wp.static(math.pi) * (p - 2.0 * wp.rint(0.5 * p))
            encoding[row, column + band] = number(wp.sin(angle))
            encoding[row, column + band + dims * bands] = number(wp.cos(angle))
            p *= float(1 << lanes)

    return encode
