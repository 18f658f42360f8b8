"""Sinusoidal encoding in plain torch, any dtype."""

import math

import torch
from torch import Tensor


def encode(values: Tensor, bands: int) -> Tensor:
    """γ(p): the values, all sines of each value, all cosines of each value."""
    frequencies = math.pi * 2.0 ** torch.arange(bands, dtype=values.dtype)
    angles = (values[:, :, None] * frequencies).flatten(1)
    return torch.cat([values, angles.sin(), angles.cos()], 1)
