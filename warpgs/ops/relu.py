"""The way back through ReLU and the bias before it (kernels/relu.py)."""

import torch
from jaxtyping import Float16, Float32
from torch import Tensor

from warpgs.kernels import relu as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import Run

MAX_CHUNKS = 4096
"""Sums that the rows are divided among: enough threads to keep memory busy, few enough to be quickly added up."""

ROWS_PER_CHUNK = 4
"""Rows of one sum, at least."""


def num_sums(num_rows: int) -> int:
    """Partial sums to divide so many rows among."""
    return min(MAX_CHUNKS, -(-num_rows // ROWS_PER_CHUNK))


def relu_backward(
    features: Float16[Tensor, "N read"],
    gradients: Float16[Tensor, "N columns"],
    sums: Float32[Tensor, "chunks columns"],
) -> None:
    """Sets gradients to zero, in place, where features are not positive, and adds them up over the rows.

    Args:
        features: [N, ≥ columns] what ReLU made, in the first columns.
        gradients: [N, columns] with respect to it; a multiple of 8 columns.
        sums: [num_sums(N), columns] to be filled with partial sums of the masked gradients; their sum over the first
            axis is the gradient of the bias.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    sizes: dict[str, int] = {"chunks": num_sums(len(gradients))}
    check_tensor("features", features, ("N", "read"), sizes, (torch.float16,))
    check_tensor("gradients", gradients, ("N", "columns"), sizes, (torch.float16,))
    check_tensor("sums", sums, ("chunks", "columns"), sizes)
    check_same_device({"features": features, "gradients": gradients, "sums": sums})
    columns = gradients.shape[1]
    if columns % kernels.PIECE or columns > features.shape[1]:
        raise ValueError(
            f"gradients must have a multiple of {kernels.PIECE} columns, "
            f"{features.shape[1]} at most as features have, got {columns}"
        )
    run = Run(gradients.device, [])
    pieces = columns // kernels.PIECE
    run.launch(kernels.relu_bwd, len(sums) * pieces, features, gradients, sums, work=ROWS_PER_CHUNK)
