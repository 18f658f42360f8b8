"""Dropout of Gaussians in plain torch, any dtype, with Warp's generator: the hash PCG-RXS-M-XS of seed and index."""

import torch
from torch import Tensor

WORD = 2**32 - 1


def pcg(state: Tensor) -> Tensor:
    """The hash of 32-bit words, which int64 holds."""
    state = (state * 747796405 + 2891336453) & WORD
    word = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & WORD
    return (word >> 22) ^ word


def random_numbers(seed: int, num: int) -> Tensor:
    """[num] multiples of 2⁻²⁴ in [0, 1)."""
    state = pcg((seed + pcg(torch.arange(num))) & WORD)
    return (pcg(state) >> 8) / 2.0**24


def dropout(opacities: Tensor, seed: int, fraction: float) -> Tensor:
    keeps = random_numbers(seed, len(opacities)) >= fraction
    return torch.where(keeps, opacities / (1.0 - fraction), 0.0).clamp_max(1.0)
