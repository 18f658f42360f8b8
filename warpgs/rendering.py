"""Rendering: splats, camera, background → images."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from .cameras import Camera
from .config import RenderSettings
from .model.splats import Splats
from .ops.compositing import NUM_BRANCH_IMAGES, Composite, record_composite
from .ops.projection import record_projection
from .ops.rows import Rows
from .ops.sh import record_sh
from .ops.tiles import record_tiles
from .runtime.checks import check_same_device, check_tensor
from .runtime.replay import repeated
from .runtime.streams import join
from .runtime.tape import Run, differentiable

DEFAULTS = RenderSettings()


class Layer(NamedTuple):
    """One image.

    Attributes:
        image: [H, W, C] over the background.
        alpha: [H, W] opacity, in [0, 1).
        depth: [H, W] mean depth of what was drawn, weighted by its contribution [scene units]; 0 where nothing was.
            None unless asked for.
    """

    image: Float[Tensor, "H W C"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None


@dataclass(frozen=True)
class Rendering:
    """What ``render`` makes.

    Attributes:
        joint: All Gaussians.
        static, dynamic: The Gaussians of one branch alone; None unless asked for.
        radii: [N, 2] half sizes on screen [px]; 0 = culled.
        gradient_norms: [N, 2] after the backward pass: length of the screen-space gradient of each mean, plain and (if
            asked for) with absolute values per pixel, in normalised device coordinates as 3DGS densifies by.
        contributed: [N] whether the Gaussian changed a pixel of the joint image; None unless asked for.
        weights: [N] sum of its blend weights over the joint image, without a gradient; None unless asked for.
    """

    joint: Layer
    static: Layer | None
    dynamic: Layer | None
    radii: Int32[Tensor, "N 2"]
    gradient_norms: Float[Tensor, "N 2"]
    contributed: Bool[Tensor, " N"] | None
    weights: Float[Tensor, " N"] | None


def render(
    splats: Splats,
    camera: Camera,
    background: Float[Tensor, " C"] | Float[Tensor, "3 C"] | None = None,
    settings: RenderSettings | None = None,
) -> Rendering:
    """Renders splats through a camera; differentiable in every splat parameter and in the background.

    Gaussians that are behind the near plane, outside the image, fainter than 1/255 or that have an opacity above 1, a
    parameter that is not finite or a zero quaternion are culled: they leave the image unchanged and get zero gradients.

    Args:
        splats: N Gaussians, N may be 0.
        camera: On the device of the splats. No gradient flows to it.
        background: [C] colour behind everything, black by default; with branches also [3, C], behind the joint, the
            static and the dynamic image.
        settings: What to compute besides the joint image.

    Returns:
        A ``Rendering``.

    Raises:
        ValueError: If the background does not fit the splats, devices differ, or branches are asked for of splats
            without ``is_dynamic``.
    """
    settings = settings or DEFAULTS
    C = splats.num_channels
    if background is not None:
        is_one_each = settings.branches and isinstance(background, Tensor) and background.ndim == 2
        check_tensor("background", background, (NUM_BRANCH_IMAGES, C) if is_one_each else (C,), {})
    check_same_device({"splats": splats.means, "camera": camera.viewmat, "background": background})
    branch = None
    if settings.branches:
        if splats.is_dynamic is None:
            raise ValueError("branches were asked for, but splats.is_dynamic is None")
        branch = splats.is_dynamic.view(torch.uint8)
    degree = None if splats.sh is None else splats.sh_degree
    if degree is None and splats.sh is not None:
        degree = round(splats.sh.shape[1] ** 0.5) - 1

    appearance = splats.colors if splats.sh is None else splats.sh
    geometry = (splats.means, splats.quats, splats.scales, splats.opacities)
    view = [t.detach() if t.requires_grad else t for t in (camera.viewmat, camera.K)]
    tensors = (*geometry, appearance, background, *view, branch)
    kind = (camera.size, C, settings, degree)
    op = partial(_record, *kind, splats.sh_stream)
    is_empty = 0 in (splats.means.shape[0], *camera.size)
    if settings.replay and splats.sh_stream is None and not is_empty:
        outputs = repeated(kind, op, *tensors)
    else:
        outputs = differentiable(op, *tensors)
    num_images = NUM_BRANCH_IMAGES if settings.branches else 1
    composite = Composite.from_flat(outputs[1:], num_images, settings.depth)
    depths = composite.depths or (None,) * num_images
    layers = [Layer(*parts) for parts in zip(composite.images, composite.alphas, depths, strict=True)]
    return Rendering(
        joint=layers[0],
        static=layers[1] if settings.branches else None,
        dynamic=layers[2] if settings.branches else None,
        radii=outputs[0],
        gradient_norms=composite.norms,
        contributed=composite.contributed,
        weights=composite.weights,
    )


def _record(
    size: tuple[int, int],
    num_channels: int,
    settings: RenderSettings,
    sh_degree: int | None,
    sh_stream: torch.cuda.Stream | None,
    run: Run,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    appearance: Tensor,
    background: Tensor | None,
    viewmat: Tensor,
    K: Tensor,
    branch: Tensor | None,
) -> tuple[Tensor, ...]:
    """What is done with the tensors of a render; it depends on nothing else than what is given here."""
    geometry = (means, quats, scales, opacities, viewmat, K)
    projection = record_projection(run, *geometry, size, settings.near, settings.antialias)
    rows = Rows(run, projection, num_channels, settings.depth, size)
    tiles = record_tiles(run, rows, size, branch)
    join(sh_stream)
    features = appearance
    if sh_degree is not None:
        features = record_sh(run, means, appearance, viewmat, projection.radii, sh_degree)
    rows.add_features(run, features)
    composite = record_composite(run, rows, tiles, size, background, settings.statistics, settings.absgrad)
    return (projection.radii, *composite.flat())
