"""Renders for ``warpgs bench`` to measure, by this package and by others."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.ops.sh import degree_of
from warpgs.rendering import render

from .scenes import SEED


def parameter_names(splats: Splats) -> tuple[str, ...]:
    """Names of the tensors whose gradients are computed; the last one is the appearance."""
    return ("means", "quats", "scales", "opacities", "colors" if splats.sh is None else "sh")


@dataclass(frozen=True)
class Workload:
    """A render and its backward pass.

    Attributes:
        render: Renders the images, of other tensors in the place of the parameters if they are given.
        parameters: Tensors to compute gradients of.
        names: Their names.
        v_images: Gradient with respect to each image.
    """

    render: Callable[..., tuple[Tensor, ...]]
    parameters: tuple[Tensor, ...]
    names: tuple[str, ...]
    v_images: tuple[Tensor, ...]

    def forward(self) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return self.render()

    def forward_backward(self) -> tuple[Tensor, ...]:
        return torch.autograd.grad(self.render(), self.parameters, self.v_images)

    def forward_backward_on_one_thread(self) -> tuple[Tensor, ...]:
        """Both passes without autograd's thread for the device, which has to wake up and starts with cold caches."""
        with torch.autograd.set_multithreading_enabled(False):
            return self.forward_backward()


def graphed(workload: Workload) -> Workload:
    """The workload as two CUDA graphs, one of each pass, from ``torch.cuda.make_graphed_callables``."""
    render: Any = torch.cuda.make_graphed_callables(workload.render, workload.parameters)
    return dataclasses.replace(workload, render=partial(render, *workload.parameters))


def make_workload(splats: Splats, camera: Camera, settings: RenderSettings) -> Workload:
    """A render by this package, with random gradients that depend only on the sizes of its images."""
    names = parameter_names(splats)

    def run(*parameters: Tensor) -> tuple[Tensor, ...]:
        given: dict[str, Any] = dict(zip(names, parameters, strict=True)) if parameters else {}
        own = dataclasses.replace(splats, **given) if given else splats  # which checks them
        rendering = render(own, camera, settings=settings)
        layers = [layer for layer in (rendering.joint, rendering.static, rendering.dynamic) if layer is not None]
        return tuple(t for layer in layers for t in (layer.image, layer.depth) if t is not None)

    with torch.no_grad():
        images = run()
    generator = torch.Generator().manual_seed(SEED)
    v_images = tuple(
        torch.randn(image.shape, dtype=torch.float32, generator=generator).to(image.device) for image in images
    )
    return Workload(run, tuple(getattr(splats, name) for name in names), names, v_images)


def make_gsplat_workload(ours: Workload, camera: Camera, settings: RenderSettings) -> Workload:
    """The render of ``ours`` by gsplat."""
    from gsplat import rasterization

    views, intrinsics, depth = camera.viewmat[None], camera.K[None], settings.depth
    options = {
        "packed": False,
        "render_mode": "RGB+ED" if depth else "RGB",
        "rasterize_mode": "antialiased" if settings.antialias else "classic",
        "sh_degree": sh_degree_of(ours),
    }

    def run() -> tuple[Tensor, ...]:
        images, _, _ = rasterization(*ours.parameters, views, intrinsics, *camera.size, **options)
        return (images[0, ..., :-1], images[0, ..., -1]) if depth else (images[0],)

    return dataclasses.replace(ours, render=run)


def sh_degree_of(workload: Workload) -> int | None:
    """Degree of the spherical harmonics of a render; None if its Gaussians have colours."""
    return degree_of(workload.parameters[-1].shape[1]) if workload.names[-1] == "sh" else None


def make_gswarp_workload(ours: Workload, camera: Camera, settings: RenderSettings) -> Workload:
    """The render of ``ours`` by gswarp, called as the rasterizer of 3DGS: near plane at 0.2, alpha at most 0.99."""
    import gswarp

    width, height = camera.size
    focal_x, focal_y = camera.K[0, 0].item(), camera.K[1, 1].item()
    projection = camera.viewmat.new_zeros(4, 4)  # OpenGL's, without a use of depth; the principal point is the center
    projection[0, 0], projection[1, 1] = 2 * focal_x / width, 2 * focal_y / height
    projection[2, 2] = projection[3, 2] = 1.0
    rasterization = gswarp.GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=width / (2 * focal_x),
        tanfovy=height / (2 * focal_y),
        bg=camera.viewmat.new_zeros(3),
        scale_modifier=1.0,
        viewmatrix=camera.viewmat.T.contiguous(),
        projmatrix=(projection @ camera.viewmat).T.contiguous(),
        sh_degree=sh_degree_of(ours) or 0,
        campos=camera.viewmat.inverse()[:3, 3].contiguous(),
        prefiltered=False,
        antialiasing=settings.antialias,
        auto_tune_verbose=False,
    )
    gswarp.set_compute_depth(settings.depth)
    rasterizer = gswarp.GaussianRasterizer(rasterization)  # which expects unit quaternions
    offsets = torch.zeros_like(ours.parameters[0], requires_grad=True)
    keyword = "colors_precomp" if ours.names[-1] == "colors" else "shs"

    def run() -> tuple[Tensor, ...]:
        means, quats, scales, opacities, appearance = ours.parameters
        image, _, meta = rasterizer(
            means, offsets, opacities[:, None], scales=scales, rotations=normalize(quats), **{keyword: appearance}
        )
        image = image.movedim(0, -1)
        # Its depth is a sum; that of the others is divided by alpha.
        return (image, meta.depth[0] / meta.alpha[0].clamp_min(1e-10)) if settings.depth else (image,)

    return dataclasses.replace(ours, render=run)


OTHERS = {"gsplat": make_gsplat_workload, "gswarp": make_gswarp_workload}
"""Other renderers by the name of their package."""
