"""Sinusoidal encoding of positions and time (paper Eq. 6).

    γ(p) = (p, sin(2⁰ π p) … sin(2ᴸ⁻¹ π p), cos(2⁰ π p) … cos(2ᴸ⁻¹ π p)) with p = (value - center) / half_size

Columns: the D values, then D L sines, a value's frequencies together, then the cosines in the same order. It has no
adjoint: positions get no gradient from the networks, as in Deformable-3DGS, and time is given.
"""

import functools
import math

import warp as wp


@functools.cache
def make_encode(half: bool) -> wp.Kernel:
    """Kernel that writes one number of an encoding, one thread each, in half or single precision."""
    number = wp.float16 if half else wp.float32

    @wp.kernel(enable_backward=False, module="unique")
    def encode(
        first: int,
        values: wp.array2d[float],
        center: wp.array[float],
        half_size: wp.array[float],
        bands: int,
        encoding: wp.array2d[number],
    ):
        thread = first + wp.tid()
        columns = encoding.shape[1]
        row = thread // columns
        column = thread - row * columns
        dims = values.shape[1]
        axis = column
        if column >= dims:
            axis = ((column - dims) % (dims * bands)) // bands
        p = (values[row, axis] - center[axis]) / half_size[axis]
        result = p
        if column >= dims:
            band = (column - dims) % bands
            angle = p * wp.static(math.pi) * float(1 << band)
            if column < dims + dims * bands:
                result = wp.sin(angle)
            else:
                result = wp.cos(angle)
        encoding[row, column] = number(result)

    return encode
