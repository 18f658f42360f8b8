"""Where training begins: the first Gaussians of both branches, and monocular depth in scene units."""

import torch
from jaxtyping import Float
from torch import Tensor

from . import depth
from .config import RenderSettings, TrainConfig
from .data.capture import Capture
from .render import render
from .scene import init
from .scene.gaussians import Gaussians
from .scene.split import SplitScene
from .views import Views

COLOR_VIEWS = 12
"""Training views from which points without colours take theirs, at most."""

LIFTED_SHARE = 8
"""Moving pixels that are lifted, for each dynamic Gaussian to begin with, at most."""

LARGEST_SHARE = 0.5
"""Largest first Gaussian of unknown place, as a share of the size at which densification removes it."""


def first_scene(config: TrainConfig, capture: Capture, generator: torch.Generator) -> SplitScene:
    """Static Gaussians at the sparse points (anywhere in the scene's box if there are none) and no dynamic ones yet."""
    center, half_size = init.scene_box(capture.points)
    degree = config.model.sh_degree
    static = Gaussians.empty(0, degree)
    if config.assume != "dynamic":
        static = init.from_points(*_colored_points(config, capture, generator), degree)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return SplitScene(static, Gaussians.empty(0, degree), config.model, center, half_size)


def _colored_points(config: TrainConfig, capture: Capture, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    points, colors, most = capture.points, capture.point_colors, config.model.max_static_points
    if len(points) == 0:
        points, colors = _anywhere(*init.scene_box(points), most, generator), None
    chosen = init.subsample(points, most, generator)
    points = points[chosen]
    if colors is not None:
        return points, colors[chosen].float() / 255.0
    seen = []
    for name in capture.train[:: -(-len(capture.train) // COLOR_VIEWS)]:
        frame = capture.frame(name)
        mask = frame.static_mask if config.assume == "masks" else None
        everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        seen.append((frame.camera, frame.image, everywhere if mask is None else mask))
    return points, init.color_points(points, seen)


def dynamic_gaussians(
    config: TrainConfig,
    capture: Capture,
    views: Views,
    alignments: Float[Tensor, "T 2"],
    scene: SplitScene,
    generator: torch.Generator,
) -> Gaussians:
    """Dynamic Gaussians at moving pixels lifted by aligned depth; without depth, anywhere in the scene's box.

    Where nothing moves there are none.
    """
    most, degree = config.model.dynamic_points, config.model.sh_degree
    if config.assume == "static":
        return Gaussians.empty(0, degree)
    if config.assume == "dynamic" and len(capture.points):
        return init.from_points(*_colored_points(config, capture, generator), degree)
    num_moving = sum(int((~views[index].static_mask).sum()) for index in range(len(views)))
    if num_moving == 0:
        return Gaussians.empty(0, degree)
    share = LIFTED_SHARE * most / num_moving
    lifted = [_lift(views, index, alignments[index], share, generator) for index in range(len(views))]
    positions, colors = (torch.cat(values) for values in zip(*lifted, strict=True))
    if len(positions) == 0:
        trunk = scene.deformation.trunk
        positions = _anywhere(trunk.center.cpu(), trunk.half_size.cpu(), most, generator)
        largest = LARGEST_SHARE * config.densify.max_size * capture.extent
        return init.from_points(positions, torch.full_like(positions, 0.5), degree, largest)
    chosen = init.subsample(positions, most, generator)
    return init.from_points(positions[chosen], colors[chosen], degree)


def _anywhere(center: Tensor, half_size: Tensor, count: int, generator: torch.Generator) -> Tensor:
    return center + half_size * (2.0 * torch.rand(count, 3, generator=generator) - 1.0)


def _lift(
    views: Views, index: int, alignment: Tensor, share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Positions and colours of a random share of a view's moving pixels, on the CPU."""
    view = views[index]
    wanted = ~view.static_mask
    if share < 1.0:
        wanted = wanted & (torch.rand(wanted.shape, generator=generator) < share).to(wanted.device)
    metric = depth.metric_depth(view.inverse_depth, alignment)
    points, colors = init.lift(metric, wanted, view.image, view.camera)
    return points.cpu(), colors.cpu()


def align_to_points(capture: Capture, views: Views) -> Float[Tensor, "T 2"]:
    """Scale and offset of each view's inverse depth against the sparse points; NaN where that can't be told."""
    alignments = torch.full((len(views), 2), torch.nan, device=views.device)
    points = capture.points.to(views.device)
    for index in range(len(views)):
        view = views[index]
        alignments[index] = depth.align_to_points(view.inverse_depth, view.static_mask, view.camera, points)
    return alignments


@torch.no_grad()
def align_to_rendering(
    alignments: Float[Tensor, "T 2"], views: Views, scene: SplitScene, sh_degree: int, antialias: bool = False
) -> Float[Tensor, "T 2"]:
    """The same against the depth rendered so far; views where that can't be told keep their alignment."""
    splats = scene.static_splats(sh_degree)
    settings = RenderSettings(depth=True, antialias=antialias)
    found = alignments.clone()
    for index in range(len(views)):
        view = views[index]
        layer = render(splats, view.camera, settings=settings).joint
        assert layer.depth is not None
        found[index] = depth.align_to_rendering(view.inverse_depth, view.static_mask, layer.depth, layer.alpha)
    return torch.where(found.isfinite(), found, alignments)
