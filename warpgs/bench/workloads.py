"""Renders that ``warpgs bench`` measures, this package's own and others."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.rendering import render

from .scenes import SEED

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Workload:
    """A render and its way back.

    Attributes:
        draw: Makes the images.
        parameters: What gradients are asked for, in the order of ``PARAMETERS``.
        cotangents: One for each image.
    """

    draw: Callable[[], tuple[Tensor, ...]]
    parameters: tuple[Tensor, ...]
    cotangents: tuple[Tensor, ...]

    def forward(self) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return self.draw()

    def forward_backward(self) -> tuple[Tensor, ...]:
        return torch.autograd.grad(self.draw(), self.parameters, self.cotangents)

    def forward_backward_on_one_thread(self) -> tuple[Tensor, ...]:
        """The same without autograd's thread for the device, which costs waking up and cold caches."""
        with torch.autograd.set_multithreading_enabled(False):
            return self.forward_backward()


def make_workload(splats: Splats, camera: Camera, settings: RenderSettings) -> Workload:
    """This package's render with random cotangents, the same for every render of these images."""

    def draw() -> tuple[Tensor, ...]:
        rendering = render(splats, camera, settings=settings)
        layers = [layer for layer in (rendering.joint, rendering.static, rendering.dynamic) if layer is not None]
        return tuple(t for layer in layers for t in (layer.image, layer.depth) if t is not None)

    with torch.no_grad():
        images = draw()
    generator = torch.Generator().manual_seed(SEED)
    cotangents = tuple(torch.randn(image.shape, generator=generator).to(image.device) for image in images)
    return Workload(draw, tuple(getattr(splats, name) for name in PARAMETERS), cotangents)


def make_gsplat_workload(ours: Workload, camera: Camera, depth: bool) -> Workload:
    """The same render by gsplat."""
    from gsplat import rasterization

    views, intrinsics = camera.viewmat[None], camera.K[None]
    mode = "RGB+ED" if depth else "RGB"

    def draw() -> tuple[Tensor, ...]:
        images, _, _ = rasterization(*ours.parameters, views, intrinsics, *camera.size, packed=False, render_mode=mode)
        return (images[0, ..., :-1], images[0, ..., -1]) if depth else (images[0],)

    return Workload(draw, ours.parameters, ours.cotangents)
