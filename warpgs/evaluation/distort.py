"""Renders as a distorting lens sees them."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from warpgs.rendering import Layer, Rendering


def distort(rendering: Rendering, positions: Float[Tensor, "H W 2"]) -> Rendering:
    """The layers of a rendering at other positions: images with bicubic interpolation, without depth.

    Args:
        rendering: Through the wide camera of a ``TakenFrame``.
        positions: [H, W, 2] its positions, on any device.
    """
    height, width = rendering.joint.alpha.shape
    size = torch.tensor([width, height], dtype=torch.float32, device=rendering.joint.alpha.device)
    grid = 2.0 * positions.to(size.device) / size - 1.0
    static, dynamic = (
        None if layer is None else _sampled(layer, grid) for layer in (rendering.static, rendering.dynamic)
    )
    return rendering._replace(joint=_sampled(rendering.joint, grid), static=static, dynamic=dynamic)


def _sampled(layer: Layer, grid: Float[Tensor, "H W 2"]) -> Layer:
    values = torch.cat([layer.image, layer.alpha[..., None]], 2).permute(2, 0, 1)[None]
    sampled = grid_sample(values, grid[None], mode="bicubic", padding_mode="border", align_corners=False)[0]
    return Layer(sampled[:-1].permute(1, 2, 0).contiguous(), sampled[-1].clamp(0, 1), None)
