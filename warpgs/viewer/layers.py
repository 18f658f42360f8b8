"""What the viewer can show of a scene."""

import dataclasses
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.rendering import render
from warpgs.visualize import depth_image, to_bytes

LayerName = Literal["joint", "static", "dynamic", "depth", "alpha", "dynamic mask"]
LAYERS: tuple[LayerName, ...] = get_args(LayerName)

SEEN_ALPHA = 0.5
"""A pixel has a colour in the depth layer where it is at least this opaque."""


@torch.no_grad()
def picture(splats: Splats, camera: Camera, layer: LayerName, antialias: bool = False) -> UInt8[np.ndarray, "H W 3"]:
    """An 8-bit RGB image of one layer.

    The dynamic mask is the share of each pixel that dynamic Gaussians have in the joint image: what static ones hide
    is not in it.
    """
    camera = camera.to(splats.means.device)
    if layer == "dynamic mask":
        assert splats.is_dynamic is not None
        splats = dataclasses.replace(splats, colors=splats.is_dynamic.float()[:, None], sh=None, sh_degree=None)
    branches = layer in ("static", "dynamic")
    settings = RenderSettings(branches=branches, depth=layer == "depth", antialias=antialias)
    rendering = render(splats, camera, settings=settings)
    shown = {"static": rendering.static, "dynamic": rendering.dynamic}.get(layer, rendering.joint)
    assert shown is not None
    if layer == "depth":
        assert shown.depth is not None
        return depth_image(_inverse_depth(shown.depth, shown.alpha))
    image = shown.alpha[..., None] if layer == "alpha" else shown.image
    return to_bytes(image.expand(-1, -1, 3))


def _inverse_depth(depth: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> Float[np.ndarray, "H W"]:
    """Inverse depth, NaN where less than ``SEEN_ALPHA`` is opaque."""
    seen = ((alpha >= SEEN_ALPHA) & (depth > 0)).cpu().numpy()
    return 1.0 / np.where(seen, depth.cpu().numpy(), np.nan)
