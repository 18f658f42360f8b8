"""Sinusoidal encoding of positions and time (kernels/encoding.py)."""

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import encoding as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import Run

ALIGNMENT = 8
"""Rows are padded with zeros to multiples of this: tensor cores want rows of 16 bytes."""


def encode(
    means: Float[Tensor, "N 3"],
    time: Float[Tensor, "1"],
    bands: tuple[int, int],
    center: Float[Tensor, "3"],
    half_size: Float[Tensor, "3"],
    room: int = 0,
    half: bool = False,
) -> Float[Tensor, "N columns"]:
    """[γ(p), γ(t)] of paper Eq. 6 for p = (means − center) / half_size. No gradient flows back.

    Args:
        means: [N, 3] positions.
        time: [1] one moment for all of them, in [0, 1].
        bands: Numbers of frequencies L of positions and of time; the lowest has wavelength 2.
        center, half_size: [3] box that becomes [-1, 1].
        room: Columns to leave before the encoding, unset.
        half: Whether to write half precision.

    Returns:
        [N, room + columns]: p, then sin(2ᵏ π p), then cos(2ᵏ π p) for k = 0 … L − 1; t alike; then zeros.

    Raises:
        ValueError: On a wrong shape, dtype or device.
    """
    sizes: dict[str, int] = {}
    check_tensor("means", means, ("N", 3), sizes)
    check_tensor("time", time, (1,), sizes)
    check_tensor("center", center, (3,), sizes)
    check_tensor("half_size", half_size, (3,), sizes)
    check_same_device({"means": means, "time": time, "center": center, "half_size": half_size})
    with torch.no_grad():
        run = Run(means.device, [])
        columns = aligned(encoded_size(*bands))
        encoding = run.empty(len(means), room + columns, dtype=torch.float16 if half else torch.float32)
        lanes_log2 = kernels.CUDA_LANES_LOG2 if run.is_cuda else 0
        arguments = (means, time, center, half_size, *bands, room, lanes_log2, encoding)
        run.launch(kernels.make_encode(half), 4 * len(means) << lanes_log2, *arguments)
    return encoding


def aligned(number: int) -> int:
    """The next multiple of ``ALIGNMENT``."""
    return number + -number % ALIGNMENT


def encoded_size(position_bands: int, time_bands: int) -> int:
    """Columns of ``encode`` before the zeros."""
    return 3 * (1 + 2 * position_bands) + 1 + 2 * time_bands
