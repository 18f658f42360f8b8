"""Sinusoidal encoding of positions and time (kernels/encoding.py)."""

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import encoding as kernels

from .contracts import check_same_device, check_tensor
from .tape import Run


def encode(
    values: Float[Tensor, "N D"],
    bands: int,
    center: Float[Tensor, " D"],
    half_size: Float[Tensor, " D"],
    half: bool = False,
) -> Float[Tensor, "N D*(1+2*{bands})"]:
    """γ(p) of paper Eq. 6 for p = (values − center) / half_size. No gradient flows back.

    Args:
        values: [N, D] coordinates.
        bands: Number of frequencies L; the lowest has wavelength 2 in p.
        center, half_size: [D] box that becomes [-1, 1].
        half: Whether to write half precision.

    Returns:
        [N, D (1 + 2 L)]: the values, then sin(2ᵏ π p) and cos(2ᵏ π p) for k = 0 … L − 1.

    Raises:
        ValueError: On a wrong shape, dtype or device.
    """
    sizes: dict[str, int] = {}
    check_tensor("values", values, ("N", "D"), sizes)
    check_tensor("center", center, ("D",), sizes)
    check_tensor("half_size", half_size, ("D",), sizes)
    check_same_device({"values": values, "center": center, "half_size": half_size})
    with torch.no_grad():
        run = Run(values.device, [])
        encoding = run.empty(
            len(values), encoded_size(values.shape[1], bands), dtype=torch.float16 if half else torch.float32
        )
        run.launch(kernels.make_encode(half), encoding.numel(), values, center, half_size, bands, encoding)
    return encoding


def encoded_size(dims: int, bands: int) -> int:
    """Columns that ``encode`` makes of ``dims`` coordinates."""
    return dims * (1 + 2 * bands)
