"""Layers of composites in plain torch, any dtype."""

from torch import Tensor

SMALLEST_ALPHA = 1e-6


def layers(composite: Tensor, alpha: Tensor, with_depth: bool) -> list[Tensor]:
    """Images, alphas and, if the last channel of [num, H, W, channels] is depth, depths."""
    if not with_depth:
        return [*composite, *alpha]
    return [*composite[..., :-1], *alpha, *(composite[..., -1] / alpha.clamp_min(SMALLEST_ALPHA))]
