"""Splat rows and their gradients in plain torch, any dtype."""

import math

import torch
from torch import Tensor

LOG2_E = math.log2(math.e)


def pack(means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor) -> Tensor:
    """[N, parts · 4] rows of visible splats: x, y, a, b, c, log2 opacity, 0, 0, features, zeros."""
    zeros = torch.zeros_like(means2d)
    scaled = LOG2_E * conics * conics.new_tensor([0.5, 1.0, 0.5])
    rows = torch.cat([means2d, scaled, opacities.log2()[:, None], zeros, features], 1)
    return torch.nn.functional.pad(rows, (0, -features.shape[1] % 4))


def unpack(rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """means2d, conics, opacities and features of rows [N, parts, 4]; those of culled splats are undefined."""
    values = rows.flatten(1)
    conics = values[:, 2:5] * rows.new_tensor([2.0, 1.0, 2.0]) / LOG2_E
    return values[:, :2], conics, values[:, 5].exp2(), values[:, 8:]


def log_alpha(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor) -> Tensor:
    """[N, P] natural logarithm of alpha at pixels [P, 2]."""
    d = means2d[:, None] - pixels
    a, b, c = (entry[:, None] for entry in conics.unbind(1))
    return opacities.log()[:, None] - 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) - b * d[..., 0] * d[..., 1]


def moments(means2d: Tensor, pixels: Tensor, s: Tensor) -> Tensor:
    """[N, 6] Σ s, Σ s dx, Σ s dy, Σ s dx², Σ s dx dy, Σ s dy² over pixels [P, 2], for s [N, P]."""
    dx, dy = (means2d[:, None] - pixels).unbind(-1)
    terms = (torch.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy)
    return torch.stack([(s * term).sum(1) for term in terms], 1)


def splat_gradients(conics: Tensor, opacities: Tensor, sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics and opacities (which may be 0) from the moments [N, 6 …] of s = alpha v_alpha."""
    s, dx, dy, dx_dx, dx_dy, dy_dy = sums[:, :6].unbind(1)
    a, b, c = conics.unbind(1)
    v_means2d = -torch.stack([a * dx + b * dy, b * dx + c * dy], 1)
    return v_means2d, -torch.stack([0.5 * dx_dx, dx_dy, 0.5 * dy_dy], 1), s / opacities.clamp_min(1e-30)
