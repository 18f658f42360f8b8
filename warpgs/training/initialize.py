"""Where training begins: the first Gaussians of both branches, and monocular depth in scene units."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import RenderSettings, TrainConfig
from warpgs.data import depth_alignment as depth
from warpgs.data.capture import Capture
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.rendering import render

from . import point_cloud as init
from .views import View, Views

COLOR_VIEWS = 12
"""Training views from which points without colours take theirs, at most."""

LIFTED_SHARE = 8
"""Moving pixels that are lifted, for each dynamic Gaussian to begin with, at most."""

MIN_KNOWN_FRACTION = 0.1
"""Share of the moving pixels that depth must be known of; depth from motion knows that of what stands still only."""

NEAREST_POINTS = 8
"""Points around a moving pixel that it is put before where depth is not known."""

BEFORE = 0.9
"""Its depth over that of the nearest of them."""

MAX_POINTS = 2_000
"""Points of a picture that are looked at for it."""

PIXELS_AT_ONCE = 8_192
"""Keeps the table of their distances from the points under 100 MB."""

MAX_FRACTION = 0.5
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
    """Dynamic Gaussians at moving pixels lifted by aligned depth.

    Without depth they begin before the points around them, without points anywhere in the scene's box; where nothing
    moves there are none.
    """
    most, degree = config.model.dynamic_points, config.model.sh_degree
    if config.assume == "static":
        return Gaussians.empty(0, degree)
    if config.assume == "dynamic" and len(capture.points):
        return init.from_points(*_colored_points(config, capture, generator), degree)
    num_moving = sum(int((~views[index].static_mask).sum()) for index in range(len(views)))
    if num_moving == 0:
        return Gaussians.empty(0, degree)
    share = min(1.0, LIFTED_SHARE * most / num_moving)
    planes = (depth.metric_depth(views[k].inverse_depth, alignments[k]) for k in range(len(views)))
    positions, colors = _lift(views, planes, share, generator)
    if len(positions) >= MIN_KNOWN_FRACTION * share * num_moving:
        chosen = init.subsample(positions, most, generator)
        return init.from_points(positions[chosen], colors[chosen], degree)
    points = capture.points.to(views.device)
    planes = (_before_points(views[k], points, generator) for k in range(len(views)))
    positions, colors = _lift(views, planes, share, generator)
    if len(positions) == 0:
        trunk = scene.deformation.trunk
        positions = _anywhere(trunk.center.cpu(), trunk.half_size.cpu(), most, generator)
        colors = torch.full_like(positions, 0.5)
    chosen = init.subsample(positions, most, generator)
    largest = MAX_FRACTION * config.densify.max_size * capture.extent
    return init.from_points(positions[chosen], colors[chosen], degree, largest)


def _anywhere(center: Tensor, half_size: Tensor, count: int, generator: torch.Generator) -> Tensor:
    return center + half_size * (2.0 * torch.rand(count, 3, generator=generator) - 1.0)


def _lift(
    views: Views, planes: Iterable[Float[Tensor, "H W"]], share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Positions and colours of a random share of all views' moving pixels, on the CPU.

    Args:
        views: The views.
        planes: [H, W] depth of each.
        share: At most 1.
        generator: Of the choice.
    """
    lifted = []
    for index, plane in enumerate(planes):
        view = views[index]
        wanted = ~view.static_mask
        if share < 1.0:
            wanted = wanted & (torch.rand(wanted.shape, generator=generator) < share).to(wanted.device)
        points, colors = init.lift(plane, wanted, view.image, view.camera)
        lifted.append((points.cpu(), colors.cpu()))
    positions, colors = (torch.cat(values) for values in zip(*lifted, strict=True))
    return positions, colors


def _before_points(view: View, points: Float[Tensor, "P 3"], generator: torch.Generator) -> Float[Tensor, "H W"]:
    """Depth before the nearest of the points around each moving pixel, because what moves hides what stands; else NaN.

    Where it truly is one camera does not tell; there it looks right from where it was filmed, and hides nothing else.
    """
    plane = torch.full(view.static_mask.shape, torch.nan, device=points.device)
    row, column, z, inside = view.camera.project(points)
    seen = inside.nonzero()[:, 0]
    seen = seen[init.subsample(seen, MAX_POINTS, generator).to(seen.device)]
    moving = (~view.static_mask).nonzero()
    if len(seen) == 0:
        return plane
    places = torch.stack([row[seen], column[seen]], 1).float()
    for part in moving.split(PIXELS_AT_ONCE):
        around = torch.cdist(part.float(), places).topk(min(NEAREST_POINTS, len(seen)), largest=False).indices
        plane[part[:, 0], part[:, 1]] = BEFORE * z[seen][around].amin(1)
    return plane


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
