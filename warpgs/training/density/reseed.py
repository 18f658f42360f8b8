"""New dynamic Gaussians where none shows what moves, and an end for runs that have lost a whole branch.

In its first steps the deformation network may carry all dynamic Gaussians of one object to another one. Where they
were, no Gaussian receives a gradient any more, so the object stays lost.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from warpgs.config import RenderSettings, TrainConfig
from warpgs.config.presets import far_rates
from warpgs.initialization.dynamic_points import (
    MAX_SCALE,
    DynamicPoints,
    gaussians_in_box,
    to_canonical,
    unproject_pixels,
)
from warpgs.initialization.point_cloud import gaussians_at
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.model.segments import nearest
from warpgs.rendering import render
from warpgs.training.schedule import Phase
from warpgs.views.views import View, Views

from .adaptation import Adaptation
from .operations import append

MAX_LOST_ALPHA = 0.1
"""Alpha of the dynamic image below which a dynamic pixel counts as lost; opacities that were just reset are above it
where Gaussians overlap."""

MAX_INVERSION_ERROR = 0.004
"""Maximum distance of a deformed point from where it was seen, as a fraction of the view size."""

MIN_REGION = 1e-3
"""Fraction of the training pixels above which a run does not go on without the Gaussians that show them."""


def require_branches(before: tuple[int, int], scene: SplitScene, views: Views, config: TrainConfig) -> str | None:
    """A warning if a branch has lost its last Gaussian and hardly any pixel needs it; None if no branch has.

    Args:
        before: Numbers of static and dynamic Gaussians before the scene was changed.
        scene: The scene after that.
        views: Its training views.
        config: Of the run; the error names learning rates that are far from their defaults.

    Raises:
        ValueError: If more than ``MIN_REGION`` of the training pixels need it.
    """
    after = {"static": len(scene.static), "dynamic": len(scene.dynamic)}
    lost = [name for name, count in zip(after, before, strict=True) if count and not after[name]]
    if not lost:
        return None
    branch, other = lost[0], "dynamic" if lost[0] == "static" else "static"
    counts = views.map(lambda view: (view.static_mask.sum(), (~view.static_mask).sum()))
    num_static, num_dynamic = (sum(numbers) for numbers in zip(*([*map(int, pair)] for pair in counts), strict=True))
    share = (num_static if branch == "static" else num_dynamic) / (num_static + num_dynamic)
    removed = f"the last {branch} Gaussian was removed, as transparent, oversized or rarely seen"
    if share < MIN_REGION:
        return f"{removed}; {share:.2%} of the training pixels are {branch}"
    if rates := far_rates(config):
        raise ValueError(f"{removed}, but {share:.1%} of the training pixels are {branch}{rates}")
    hint = f"; if everything is {other}, train with --assume {other}" if share < 0.5 else ""
    raise ValueError(
        f"{removed}, but {share:.1%} of the training pixels are {branch}: warpgs check may find what is wrong with the "
        f"capture{hint}"
    )


def lost_pixels(scene: SplitScene, phase: Phase, settings: RenderSettings) -> Callable[[View], Bool[Tensor, "H W"]]:
    """The function that finds the pixels of a view that are dynamic, and that no dynamic Gaussian shows."""
    settings, is_empty = replace(settings, branches=True), not len(scene.dynamic)

    @torch.no_grad()
    def mask_of(view: View) -> Bool[Tensor, "H W"]:
        delays = scene.with_delays(view.camera, view.time)
        splats = scene.splats(view.time, phase.use_deformation, phase.use_appearance, phase.sh_degree, delays)
        layer = render(splats, view.camera, settings=settings).dynamic
        assert layer is not None
        lost = ~view.static_mask & (layer.alpha < MAX_LOST_ALPHA)
        # Borders of masks may show something else, but thin objects have nothing but borders.
        return lost if view.mask_border is None or is_empty else lost & ~view.mask_border

    return mask_of


def lost_fraction(views: Views, mask_of: Callable[[View], Bool[Tensor, "H W"]]) -> float:
    """Fraction of all views' dynamic pixels that are lost, in [0, 1]; 0 if nothing is dynamic."""
    lost, dynamic = torch.zeros(2, dtype=torch.int64, device=views.device)
    for lost_here, dynamic_here in views.map(lambda view: (mask_of(view).sum(), (~view.static_mask).sum())):
        lost, dynamic = lost + lost_here, dynamic + dynamic_here
    return int(lost) / max(1, int(dynamic))


@torch.no_grad()
def gaussians_that_show(
    found: DynamicPoints, scene: SplitScene, views: Views, config: TrainConfig, view_size: float
) -> Gaussians:
    """Dynamic Gaussians that the network deforms to points, each at the time of its view.

    Points that the deformation cannot be inverted at to within ``MAX_INVERSION_ERROR`` are dropped.

    Args:
        found: The points.
        scene: Its deformation must be in use.
        views: The views of the points.
        config: Degree of spherical harmonics and limits of size.
        view_size: Of the capture [scene units].
    """
    canonical, kept = torch.empty_like(found.positions), torch.zeros(len(found.positions), dtype=torch.bool)
    segments = torch.zeros(len(found.positions), dtype=torch.int64)
    for index in found.views.unique().tolist():
        chosen = found.views == index
        seen, time = found.positions[chosen].to(views.device), views.time(index)
        _, deformation = scene.around(time)
        x, reached = to_canonical(deformation, seen, time, seen, MAX_INVERSION_ERROR * view_size)
        canonical[chosen], kept[chosen] = x.cpu(), reached.cpu()
        segments[chosen] = nearest(time.cpu(), scene.num_segments)
    added = gaussians_at(canonical[kept], found.colors[kept], config.model.sh_degree, MAX_SCALE * view_size)
    added.segments = segments[kept]
    return added


def reseed(at: Adaptation) -> None:
    """Adds dynamic Gaussians where none shows what moves."""
    if at.capture.assumption == "dynamic":
        return  # the masks do not say what moves then: they mark all that is seen
    config, scene, views, capacity = at.config, at.scene, at.views, at.capacity
    mask_of = lost_pixels(scene, at.plan.phase, config.render_settings)
    fraction = lost_fraction(views, mask_of)
    count = min(capacity, round(fraction * config.model.dynamic_points))
    if fraction < config.densify.reseed or count <= 0:
        return
    generator = at.generator("reseed")
    found = unproject_pixels(at.capture, views, at.alignments, mask_of, count, generator)
    if found is not None:
        added = gaussians_that_show(found, scene, views, config, at.capture.view_size)
        if not len(added) + len(scene.dynamic):
            added = gaussians_in_box(at.capture, count, config, generator)
            added.segments = torch.arange(count) % scene.num_segments
        append(scene.dynamic, at.optimizer, added)
        lost = f"{fraction:.0%} of the dynamic pixels show no dynamic Gaussian"
        limit = ", as many as --densify.max-gaussians allows" if count == capacity else ""
        at.log(f"{lost}; {len(added):,} added there{limit}")
