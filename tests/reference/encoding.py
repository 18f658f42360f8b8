"""Sinusoidal encoding in plain torch, any dtype."""

import math

import torch
from torch import Tensor


def encode(values: Tensor, bands: int, raw: bool = True) -> Tensor:
    """γ(p): the values if ``raw``, all sines of each value, all cosines of each value."""
    frequencies = math.pi * 2.0 ** torch.arange(bands, dtype=values.dtype)
    angles = (values[:, :, None] * frequencies).flatten(1)
    return torch.cat([*([values] if raw else []), angles.sin(), angles.cos()], 1)
