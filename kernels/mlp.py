"""Backward pass of ReLU and of the bias before it, in one pass over memory (half precision).

    h = max(0, x),   v_x = v_h · [h > 0],   v_bias = Σ over rows of v_x

Gradients are masked in place, in pieces of 16 bytes. A thread processes eight columns of every n-th row and writes
their partial sums, which are added up afterwards: without atomics, the result is deterministic.
"""

import warp as wp

from .lanes import native

PIECE = 8
"""Columns per thread: 16 bytes."""

Piece = wp.types.vector(length=PIECE, dtype=float)

# A number that is not negative is positive if and only if its bits are, read as an integer: pairs of numbers are
# compared at once, and NaN counts as positive, as in torch.
_MASK = native(
    """
    uint4* at = (uint4*)&wp::index(gradients, row, column);
    const uint4 h = *(const uint4*)&wp::index(features, row, column);
    uint4 g = *at;
    g.x &= __vcmpgts2(h.x, 0u);
    g.y &= __vcmpgts2(h.y, 0u);
    g.z &= __vcmpgts2(h.z, 0u);
    g.w &= __vcmpgts2(h.w, 0u);
    *at = g;
    const wp::half* masked = (const wp::half*)&g;
    """,
    """
    wp::half* masked = &wp::index(gradients, row, column);
    const wp::half* h = &wp::index(features, row, column);
    for (int k = 0; k < 8; ++k) if (!((short)h[k].u > 0)) masked[k].u = 0;
    """,
)


@wp.func_native(_MASK + "wp::vec_t<8, float> sum; for (int k = 0; k < 8; ++k) sum[k] = float(masked[k]); return sum;")
def mask_piece(gradients: wp.array2d[wp.float16], features: wp.array2d[wp.float16], row: int, column: int) -> Piece:
    """Masks eight columns of a row of gradients in place and returns them."""
    ...


@wp.kernel(enable_backward=False)
def relu_bwd(
    first: int,
    features: wp.array2d[wp.float16],
    gradients: wp.array2d[wp.float16],
    sums: wp.array2d[float],
):
    """Thread (chunk, piece): rows chunk, chunk + chunks, … of columns 8 piece to 8 piece + 7.

    ``features`` may have more columns, which are ignored. ``sums`` is [chunks, columns of ``gradients``].
    """
    thread = first + wp.tid()
    pieces = gradients.shape[1] // PIECE
    chunk = thread // pieces
    column = (thread - chunk * pieces) * PIECE
    sum = Piece()
    for row in range(chunk, gradients.shape[0], sums.shape[0]):
        sum += mask_piece(gradients, features, row, column)
    for k in range(PIECE):
        sums[chunk, column + k] = sum[k]
