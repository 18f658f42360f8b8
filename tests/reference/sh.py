"""Spherical harmonics from their definition with associated Legendre functions, any dtype."""

import math

import torch
from torch import Tensor


def _legendre(degree: int, order: int, z: Tensor) -> Tensor:
    """P_l^m(z) / (1 - z²)^{m/2}, with the Condon-Shortley phase, by the standard recurrences."""
    value = torch.full_like(z, math.prod(-(2 * k - 1) for k in range(1, order + 1)))
    before = torch.zeros_like(z)
    for l in range(order + 1, degree + 1):
        value, before = ((2 * l - 1) * z * value - (l + order - 1) * before) / (l - order), value
    return value


def bases(directions: Tensor, degree: int) -> Tensor:
    """[N, (degree + 1)²] real harmonics in unit directions; x, y times sin θ come in as Re, Im of (x + iy)^m."""
    x, y, z = directions.unbind(-1)
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            order = abs(m)
            real, imaginary = torch.ones_like(x), torch.zeros_like(x)
            for _ in range(order):
                real, imaginary = real * x - imaginary * y, real * y + imaginary * x
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - order) / math.factorial(l + order))
            value = norm * _legendre(l, order, z)
            if m != 0:
                value = math.sqrt(2) * value * (real if m > 0 else imaginary)
            columns.append(value)
    return torch.stack(columns, -1)


def spherical_harmonics(means: Tensor, sh: Tensor, viewmat: Tensor, degree: int) -> Tensor:
    """max(0, ½ + Σ Y_k sh_k)."""
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    directions = torch.nn.functional.normalize(means - center, dim=-1)
    Y = bases(directions, degree)
    return (0.5 + (Y[:, :, None] * sh[:, : Y.shape[1]]).sum(1)).clamp(min=0)
