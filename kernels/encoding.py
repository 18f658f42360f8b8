"""Sinusoidal encoding of positions and time (paper Eq. 6).

    γ(p) = (sin(2⁰ π p) … sin(2ᴸ⁻¹ π p), cos(2⁰ π p) … cos(2ᴸ⁻¹ π p)) with p = (mean - center) / half_size

Columns: optionally the D values themselves (Deformable-3DGS), then D L sines with the frequencies of a value side by
side, then the cosines in the same order; first for positions (D = 3), then for time (D = 1). Whole
periods are subtracted from 2ᵏ p before it is multiplied by π. Both steps are exact, so that every frequency is as
precise as the first. There is no backward pass: positions get no gradient from the networks, as in Deformable-3DGS, and
time is given.
"""

import functools
import math

import warp as wp

CUDA_LANES_LOG2 = 2
"""Base-2 logarithm of the number of threads that share the frequencies of one value on CUDA."""


@functools.cache
def make_encode(half: bool) -> wp.Kernel:
    """Kernel that writes the columns of x, y, z or t of a row, in half or single precision.

    Rows after the last position or time have the last one.

    2^``lanes_log2`` threads share these columns, one frequency at a time: neighbouring threads on CUDA, which write
    neighbouring addresses, and one thread on CPU. ``begin_column`` is the first column of the encoding; ``raw`` is 1 if
    the values themselves come first, 0 if not. The angles are in [-π, π], where CUDA's fast sine has an error of at
    most 2⁻²¹, enough for half precision.
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
        begin_column: int,
        raw: int,
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
        begin = begin_column
        p = time[wp.min(row, time.shape[0] - 1)]
        if axis < 3:
            p = (means[wp.min(row, means.shape[0] - 1), axis] - center[axis]) / half_size[axis]
        else:
            axis = 0
            dims = 1
            bands = time_bands
            begin = begin_column + (raw + 2 * position_bands) * 3
            for column in range(begin + raw + 2 * bands + lane, encoding.shape[1], lanes):
                encoding[row, column] = number(0.0)
        if lane == 0 and raw != 0:
            encoding[row, begin + axis] = number(p)
        column = begin + raw * dims + axis * bands
        p *= float(1 << lane)
        for band in range(lane, bands, lanes):
            angle = wp.static(math.pi) * (p - 2.0 * wp.rint(0.5 * p))
            encoding[row, column + band] = number(wp.sin(angle))
            encoding[row, column + band + dims * bands] = number(wp.cos(angle))
            p *= float(1 << lanes)

    return encode
