"""The images that the viewer can show of a scene."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.rendering import DEFAULTS, Layer, render
from warpgs.visualize.depth import depth_image
from warpgs.visualize.images import to_bytes
from warpgs.visualize.objects import objects_image

Image = UInt8[np.ndarray, "H W 3"]


def joint(splats: Splats, camera: Camera, settings: RenderSettings) -> Image:
    """All Gaussians."""
    return to_bytes(render(splats, camera, settings=settings).joint.image)


def static(splats: Splats, camera: Camera, settings: RenderSettings) -> Image:
    """The static Gaussians alone."""
    return _branch_image(render(splats, camera, settings=replace(settings, branches=True)).static)


def dynamic(splats: Splats, camera: Camera, settings: RenderSettings) -> Image:
    """The dynamic Gaussians alone."""
    return _branch_image(render(splats, camera, settings=replace(settings, branches=True)).dynamic)


def depth(splats: Splats, camera: Camera, settings: RenderSettings) -> Image:
    """Inverse depth in colours: red is near, blue is far, black is empty."""
    return depth_image(render(splats, camera, settings=replace(settings, depth=True)).joint.inverse_depth.cpu().numpy())


def alpha(splats: Splats, camera: Camera, settings: RenderSettings) -> Image:
    """Opacity, in grey."""
    return _grey(render(splats, camera, settings=settings).joint.alpha[..., None])


def dynamic_weight(splats: Splats, camera: Camera, settings: RenderSettings) -> Image:
    """Blend weight of the dynamic Gaussians in the joint image, in grey: those hidden by static ones have none."""
    assert splats.is_dynamic is not None
    weights = replace(splats, colors=splats.is_dynamic.float()[:, None], sh=None, sh_degree=None)
    return _grey(render(weights, camera, settings=settings).joint.image)


LAYERS: dict[str, Callable[[Splats, Camera, RenderSettings], Image]] = {
    "joint": joint,
    "static": static,
    "dynamic": dynamic,
    "depth": depth,
    "alpha": alpha,
    "dynamic weight": dynamic_weight,
    "objects": objects_image,
}
"""Layers by name, in the order of the menu. To add one, write its function and add a line here."""


@torch.no_grad()
def render_layer(name: str, splats: Splats, camera: Camera, settings: RenderSettings = DEFAULTS) -> Image:
    """An 8-bit RGB image of the layer with a name in ``LAYERS``; the camera may be on any device."""
    return LAYERS[name](splats, camera.to(splats.means.device), settings)


def _branch_image(branch: Layer | None) -> Image:
    assert branch is not None
    return to_bytes(branch.image)


def _grey(values: Float[Tensor, "H W 1"]) -> Image:
    return to_bytes(values.expand(-1, -1, 3))
