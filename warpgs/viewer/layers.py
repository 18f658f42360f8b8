"""What the viewer can show of a scene."""

import dataclasses
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.rendering import render
from warpgs.visualize import to_bytes

LayerName = Literal["joint", "static", "dynamic", "depth", "alpha", "dynamic mask"]
LAYERS: tuple[LayerName, ...] = get_args(LayerName)

SEEN_ALPHA = 0.5
"""A pixel has a colour in the depth layer where it is at least this opaque."""

DEPTH_PERCENTILES = (2.0, 98.0)
"""Inverse depths of an image that have the first and the last colour."""


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
        return _depth_picture(shown.depth, shown.alpha)
    image = shown.alpha[..., None] if layer == "alpha" else shown.image
    return to_bytes(image.expand(-1, -1, 3))


def _depth_picture(depth: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Inverse depth in colours, red near and blue far; black where nothing is."""
    seen = ((alpha >= SEEN_ALPHA) & (depth > 0)).cpu().numpy()
    if not seen.any():
        return np.zeros((*seen.shape, 3), np.uint8)
    inverse = 1.0 / np.where(seen, depth.cpu().numpy(), 1.0)
    low, high = np.percentile(inverse[seen], DEPTH_PERCENTILES)
    level = np.clip((inverse - low) / max(high - low, 1e-6), 0, 1)  # a wall at one depth is of one colour, not NaN
    colored = cv2.applyColorMap((level * 255).round().astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.where(seen[..., None], cv2.cvtColor(colored, cv2.COLOR_BGR2RGB), 0).astype(np.uint8)
