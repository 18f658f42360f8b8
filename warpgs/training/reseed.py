"""New dynamic Gaussians where none shows what moves.

In its first steps the deformation network may carry all dynamic Gaussians of one object to another one. Where they
were, no Gaussian receives a gradient any more, so the object stays lost.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from warpgs.config import RenderSettings, TrainConfig
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.rendering import render

from .dynamic_points import DynamicPoints, max_scale, to_canonical
from .point_cloud import gaussians_at
from .schedule import Phase
from .views import View, Views

MAX_LOST_ALPHA = 0.1
"""Alpha of the dynamic image below which a dynamic pixel counts as lost; opacities that were just reset are above it
where Gaussians overlap."""

MAX_INVERSION_ERROR = 0.01
"""Maximum distance of a deformed point from where it was seen, as a fraction of the extent."""


def lost_pixels(scene: SplitScene, phase: Phase, settings: RenderSettings) -> Callable[[View], Bool[Tensor, "H W"]]:
    """The function that finds the pixels of a view that are dynamic, and that no dynamic Gaussian shows."""
    settings = replace(settings, branches=True)

    @torch.no_grad()
    def mask_of(view: View) -> Bool[Tensor, "H W"]:
        splats = scene.splats(view.time, phase.use_deformation, phase.use_appearance, phase.sh_degree)
        layer = render(splats, view.camera, settings=settings).dynamic
        assert layer is not None
        lost = ~view.static_mask & (layer.alpha < MAX_LOST_ALPHA)
        return lost if view.mask_border is None else lost & ~view.mask_border

    return mask_of


def lost_fraction(views: Views, mask_of: Callable[[View], Bool[Tensor, "H W"]]) -> float:
    """Fraction of all views' dynamic pixels that are lost, in [0, 1]; 0 if nothing is dynamic."""
    lost, dynamic = torch.zeros(2, dtype=torch.int64, device=views.device)
    for lost_here, dynamic_here in views.map(lambda view: (mask_of(view).sum(), (~view.static_mask).sum())):
        lost, dynamic = lost + lost_here, dynamic + dynamic_here
    return int(lost) / max(1, int(dynamic))


@torch.no_grad()
def gaussians_that_show(
    found: DynamicPoints, scene: SplitScene, views: Views, config: TrainConfig, extent: float
) -> Gaussians:
    """Dynamic Gaussians that the network deforms to points, each at the time of its view.

    Points that the deformation cannot be inverted at to within ``MAX_INVERSION_ERROR`` are dropped.

    Args:
        found: The points.
        scene: Its deformation must be in use.
        views: The views of the points.
        config: Degree of spherical harmonics and limits of size.
        extent: Extent of the capture [scene units].
    """
    canonical, kept = torch.empty_like(found.positions), torch.zeros(len(found.positions), dtype=torch.bool)
    for index in found.views.unique().tolist():
        chosen = found.views == index
        seen, time = found.positions[chosen].to(views.device), views[index].time
        x, reached = to_canonical(scene.deformation, seen, time, seen, MAX_INVERSION_ERROR * extent)
        canonical[chosen], kept[chosen] = x.cpu(), reached.cpu()
    largest = max_scale(config, extent)
    return gaussians_at(canonical[kept], found.colors[kept], config.model, largest)
