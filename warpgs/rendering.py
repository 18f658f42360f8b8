"""Differentiable rendering: splats, camera, background → images."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from .cameras import Camera
from .config import RenderSettings
from .model.splats import Splats
from .ops.compositing import NUM_BRANCH_IMAGES, Composite, SecondNorm, record_composite
from .ops.projection import Geometry, View, record_projection
from .ops.rows import Rows
from .ops.sh import degree_of, record_sh
from .ops.tiles import record_tiles
from .runtime.checks import check_same_device, check_tensor
from .runtime.replay import differentiable_with_replay
from .runtime.streams import join
from .runtime.tape import OpContext, differentiable

DEFAULTS = RenderSettings()


class Layer(NamedTuple):
    """One image.

    Attributes:
        image: [H, W, C] composited over the background.
        alpha: [H, W] opacity, in [0, 1).
        depth: [H, W] mean depth of the Gaussians, weighted by their contribution [scene units]; 0 in empty pixels.
            None unless requested.
    """

    image: Float[Tensor, "H W C"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None


@dataclass(frozen=True)
class Rendering:
    """The result of ``render``.

    Attributes:
        joint: All Gaussians.
        static, dynamic: The Gaussians of one branch alone; None unless requested.
        radii: [N, 2] half sizes on screen [px]; 0 = culled.
        gradient_norms: [N, 2] after the backward pass: length of the screen-space gradient of each mean, plain and (if
            requested) with absolute values per pixel or of the images alone, in normalised device coordinates as in the
            densification of 3DGS.
        contributed: [N] whether the Gaussian changed a pixel of the joint image; None unless requested.
        weights: [N] sum of its blend weights over the joint image, not differentiable; None unless requested.
    """

    joint: Layer
    static: Layer | None
    dynamic: Layer | None
    radii: Int32[Tensor, "N 2"]
    gradient_norms: Float[Tensor, "N 2"]
    contributed: Bool[Tensor, " N"] | None
    weights: Float[Tensor, " N"] | None


class _Request(NamedTuple):
    """Everything but tensors that a render depends on; requests that are equal can share a recording."""

    size: tuple[int, int]
    num_channels: int
    settings: RenderSettings
    sh_degree: int | None


def render(
    splats: Splats,
    camera: Camera,
    background: Float[Tensor, " C"] | Float[Tensor, "3 C"] | None = None,
    settings: RenderSettings | None = None,
) -> Rendering:
    """Renders splats through a camera; differentiable, once, in the splats, the camera and the background.

    Gaussians that are behind the near plane, 1e10 or more from the camera, outside the image, fainter than 1/255 or
    that have an opacity above 1, a parameter that is not finite or a zero quaternion are culled: they leave the image
    unchanged and get zero gradients.

    Args:
        splats: N Gaussians; N may be 0.
        camera: On the device of the splats.
        background: [C] colour behind everything, black by default; with branches also [3, C], one for each of the
            joint, the static and the dynamic image.
        settings: What to compute besides the joint image.

    Raises:
        TypeError: If the camera is something else, such as a list of cameras.
        ValueError: If the background does not fit the splats, devices differ, or branches are requested for splats
            without ``is_dynamic``.
    """
    settings = settings or DEFAULTS
    _check_inputs(splats, camera, background, settings)
    outputs = _render(splats, camera, background, settings)
    num_images = NUM_BRANCH_IMAGES if settings.branches else 1
    composite = Composite.from_flat(outputs[1:], num_images, settings.depth)
    depths = composite.depths or (None,) * num_images
    layers = [Layer(*parts) for parts in zip(composite.images, composite.alphas, depths, strict=True)]
    return Rendering(
        joint=layers[0],
        static=layers[1] if settings.branches else None,
        dynamic=layers[2] if settings.branches else None,
        radii=outputs[0],
        gradient_norms=composite.gradient_norms,
        contributed=composite.contributed,
        weights=composite.weights,
    )


def _check_inputs(splats: Splats, camera: Camera, background: Tensor | None, settings: RenderSettings) -> None:
    if not isinstance(camera, Camera):
        raise TypeError(f"camera must be one Camera, got {type(camera).__name__}: call render once per camera")
    C = splats.num_channels
    if background is not None:
        is_per_image = settings.branches and isinstance(background, Tensor) and background.ndim == 2
        check_tensor("background", background, (NUM_BRANCH_IMAGES, C) if is_per_image else (C,), {})
    check_same_device({"splats": splats.means, "camera": camera.viewmat, "background": background})
    if settings.branches and splats.is_dynamic is None:
        raise ValueError("branches were requested, but splats.is_dynamic is None")


def _render(splats: Splats, camera: Camera, background: Tensor | None, settings: RenderSettings) -> tuple[Tensor, ...]:
    """Radii and a flat ``Composite``, differentiable, from a recording if possible."""
    degree = None if splats.sh is None else splats.sh_degree
    if degree is None and splats.sh is not None:
        degree = degree_of(splats.sh.shape[1])
    request = _Request(camera.size, splats.num_channels, settings, degree)
    branch = None if splats.is_dynamic is None or not settings.branches else splats.is_dynamic.view(torch.uint8)
    appearance = splats.colors if splats.sh is None else splats.sh
    geometry = (splats.means, splats.quats, splats.scales, splats.opacities)
    tensors = (*geometry, appearance, background, camera.viewmat, camera.K, branch)
    op = partial(_record, request, splats.sh_stream)
    is_empty = 0 in (splats.means.shape[0], *camera.size)
    if settings.replay and splats.sh_stream is None and not is_empty:
        return differentiable_with_replay(request, op, *tensors)
    return differentiable(op, *tensors)


def _record(
    request: _Request, sh_stream: torch.cuda.Stream | None, ctx: OpContext, *tensors: Any
) -> tuple[Tensor, ...]:
    """The render as one op: project → bin → composite; it depends on nothing but its arguments."""
    means, quats, scales, opacities, appearance, background, viewmat, K, branch = tensors
    size, num_channels, settings, sh_degree = request
    geometry, view = Geometry(means, quats, scales, opacities), View(viewmat, K, *size)
    projection = record_projection(ctx, geometry, view, settings.near, settings.antialias)
    rows = Rows(ctx, projection, num_channels, settings.depth, size)
    tiles = record_tiles(ctx, rows, size, branch)
    join(sh_stream)
    features = appearance
    if sh_degree is not None:
        features = record_sh(ctx, means, appearance, viewmat, projection.radii, sh_degree)
    rows.add_features(ctx, features)
    second_norm: SecondNorm = "absolute" if settings.absgrad else "images" if settings.imagegrad else None
    composite = record_composite(ctx, rows, tiles, size, background, settings.statistics, second_norm)
    return (projection.radii, *composite.flat())
