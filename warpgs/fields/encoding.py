"""Sinusoidal encoding of positions and time (paper Eq. 6)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def encode(values: Float[Tensor, "N D"], bands: int) -> Float[Tensor, "N D*(1+2*{bands})"]:
    """γ(p): the values themselves, then sin(2ᵏ π p) and cos(2ᵏ π p) for k = 0 … bands − 1.

    Args:
        values: [N, D] coordinates, about [-1, 1]: the lowest frequency has wavelength 2.
        bands: Number of frequencies L.

    Returns:
        [N, D (1 + 2 L)].
    """
    frequencies = math.pi * 2.0 ** torch.arange(bands, device=values.device, dtype=values.dtype)
    angles = (values[:, :, None] * frequencies).flatten(1)
    return torch.cat([values, angles.sin(), angles.cos()], 1)


def encoded_size(dims: int, bands: int) -> int:
    """Columns that ``encode`` makes of ``dims`` coordinates."""
    return dims * (1 + 2 * bands)
