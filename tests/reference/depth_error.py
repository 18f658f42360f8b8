"""Mean error of depth against aligned monocular depth in plain torch, any dtype."""

import torch
from torch import Tensor


def depth_error(
    depth: Tensor, alpha: Tensor, inverse_depth: Tensor, alignment: Tensor, region: Tensor, margin: Tensor
) -> Tensor:
    aligned = alignment[0] * inverse_depth + alignment[1]
    known = region & (alpha > 0.5) & (aligned > 1e-3)
    target = 1.0 / aligned[known]
    return ((depth[known] - target).abs() - margin * target).clamp_min(0.0).sum() / depth.numel()


def random_inputs(height: int, width: int, generator: torch.Generator, margin: float = 0.1) -> list[Tensor]:
    """Depth, alpha, inverse depth, alignment, region and margin, with pixels of each type that is not compared."""
    size = (height, width)
    alpha, inverse_depth = (torch.rand(size, generator=generator) for _ in range(2))
    inverse_depth[torch.rand(size, generator=generator) > 0.8] = torch.nan
    region = torch.rand(size, generator=generator) > 0.3
    depth = 10.0 * torch.rand(size, generator=generator)
    alpha[0, 0], inverse_depth[0, 0], region[0, 0] = 0.9, 0.7, True
    return [depth, alpha, inverse_depth, torch.tensor([0.8, -0.2]), region, torch.tensor(margin)]
