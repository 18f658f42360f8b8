"""Sinusoidal encoding of positions and time: on CUDA by kernels/encoding.py, on CPU by torch's vectorized sine."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import encoding as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import launch

ALIGNMENT = 8
"""Rows are padded with zeros to multiples of this: tensor cores need rows of multiples of 16 bytes."""

ROW_ALIGNMENT = 64
"""In half precision the number of rows is a multiple of this, because sums over other numbers of rows may be wrong
(docs/design/half-precision.md)."""


def encode(
    means: Float[Tensor, "N 3"],
    time: Float[Tensor, " T"],
    bands: tuple[int, int],
    box: tuple[Float[Tensor, "3"], Float[Tensor, "3"]],
    offset: int = 0,
    half: bool = False,
    raw: bool = True,
) -> Float[Tensor, "rows columns"]:
    """[γ(p), γ(t)] of paper Eq. 6 for p = (means − center) / half_size; not differentiable.

    Args:
        means: [N, 3] positions.
        time: [1] time in [0, 1] of all positions, or [N] times of each.
        bands: Numbers L of frequencies of positions and of time; the lowest frequency has wavelength 2.
        box: Center and half size, [3] each, of the box that is mapped to [-1, 1]³.
        offset: Number of columns before the encoding, left uninitialised.
        half: Whether to return half precision.
        raw: Whether p and t themselves come first.

    Returns:
        [rows, offset + columns]: p if ``raw``, sin(2ᵏ π p), cos(2ᵏ π p) for k = 0 … L − 1; the same for t; then zeros.
        There are N rows; in half precision, copies of the last one follow up to a multiple of ``ROW_ALIGNMENT``.

    Raises:
        ValueError: On a wrong shape, dtype or device.
    """
    _check_inputs(means, time, box)
    columns = aligned(encoded_size(*bands, raw))
    rows = aligned(len(means), ROW_ALIGNMENT) if half else len(means)
    encoding = means.new_empty(rows, offset + columns, dtype=torch.float16 if half else torch.float32)
    if not means.is_cuda:
        return _encode_on_cpu(means, time, bands, box, offset, raw, encoding)
    arguments = (means, time, *box, *bands, offset, int(raw), kernels.CUDA_LANES_LOG2, encoding)
    launch(kernels.make_encode(half), 4 * rows << kernels.CUDA_LANES_LOG2, *arguments)
    return encoding


def _check_inputs(means: Tensor, time: Tensor, box: tuple[Tensor, Tensor]) -> None:
    tensors = {"means": means, "time": time, "center": box[0], "half_size": box[1]}
    times = "N" if len(time) != 1 else 1
    sizes: dict[str, int] = {}
    for (name, tensor), shape in zip(tensors.items(), (("N", 3), (times,), (3,), (3,)), strict=True):
        check_tensor(name, tensor, shape, sizes)
    check_same_device(tensors)


@torch.no_grad()
def _encode_on_cpu(
    means: Tensor,
    time: Tensor,
    bands: tuple[int, int],
    box: tuple[Tensor, Tensor],
    offset: int,
    raw: bool,
    encoding: Tensor,
) -> Tensor:
    """The kernel's formulas; a call of sine in a kernel is one of the C library for each number."""
    own, column = encoding[: len(means)], offset
    for values, number in (((means - box[0]) / box[1], bands[0]), (time[:, None], bands[1])):
        scaled = values[..., None] * torch.tensor([2.0**k for k in range(number)], dtype=torch.float32)
        angles = (math.pi * (scaled - 2.0 * torch.round(0.5 * scaled))).flatten(1)
        for part in ([values] if raw else []) + [angles.sin(), angles.cos()]:
            own[:, column : column + part.shape[1]] = part
            column += part.shape[1]
    own[:, column:] = 0.0
    encoding[len(means) :] = own[-1:]
    return encoding


def aligned(number: int, alignment: int = ALIGNMENT) -> int:
    """``number`` rounded up to a multiple of ``alignment``."""
    return number + -number % alignment


def encoded_size(position_bands: int, time_bands: int, raw: bool = True) -> int:
    """Number of columns of ``encode`` without the padding."""
    return 3 * (int(raw) + 2 * position_bands) + int(raw) + 2 * time_bands
