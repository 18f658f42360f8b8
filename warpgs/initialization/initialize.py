"""The Gaussians that training starts from, of both branches."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.model.gaussians import Gaussians
from warpgs.model.mlp_deformation import MlpDeformation
from warpgs.model.scene import SplitScene
from warpgs.model.spline_deformation import SplineDeformation
from warpgs.views.part import SomeViews
from warpgs.views.views import Views

from .dynamic_points import MAX_SCALE, DynamicPoints, gaussians_in_box, is_depth_known, unproject_pixels
from .motion_fit import MAX_POINTS, IsStopped, Observed, fit_motion, never
from .point_cloud import color_points, gaussians_at, random_points, scene_box, subsample
from .sky import Sky, make_dome, without_points
from .track_paths import dynamic_paths
from .tracked_start import start_from_tracks
from .tracks import find_tracks

MAX_COLOR_VIEWS = 12
"""Maximum number of training views that tell the colours of points without colours."""

RESOLUTION = 0.25
"""Distance of points, in pixels at the capture's median depth, below which clouds of several scans or models show one
place. A Gaussian as small as the error between the scans would be culled and pruned."""


def initial_scene(
    config: TrainConfig, capture: Capture, views: Views, generator: torch.Generator, sky: Sky | None = None
) -> SplitScene:
    """Static Gaussians at the sparse points (at random ones in the scene's box if there are none), no dynamic ones yet.

    If everything is assumed to be dynamic, there are no static Gaussians either. Points in the sky (``sky``, found from
    depth) get none.
    """
    dome = None
    if config.background == "sky":
        dome, capture = make_dome(capture, sky), without_points(capture, sky)
    center, half_size = scene_box(capture.points)
    degree = config.model.sh_degree
    static = Gaussians.empty(0, degree)
    if capture.assumption != "dynamic":
        static = _gaussians_at_points(config, capture, views, generator)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        scene = SplitScene(static, Gaussians.empty(0, degree), config.model, center, half_size, dome)
    for module in scene.deformation.modules():
        if isinstance(module, MlpDeformation):
            module.units[:3] = config.offset_unit(capture.view_size)
    return scene


def _gaussians_at_points(
    config: TrainConfig, capture: Capture, views: SomeViews, generator: torch.Generator
) -> Gaussians:
    """Gaussians at a random subset of the capture's points; closer ones than its cameras resolve are at one place."""
    points, colors = _colored_points(config, capture, views, generator)
    focal = torch.stack([capture.cameras[name].focal for name in capture.train]).median()
    resolution = RESOLUTION * capture.median_depth / float(focal)
    return gaussians_at(points, colors, config.model.sh_degree, resolution=resolution)


def _colored_points(
    config: TrainConfig, capture: Capture, views: SomeViews, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """A random subset of the capture's points, with their colours or those of the frames, in [0, 1]."""
    points, colors, max_count = capture.points, capture.point_colors, config.model.max_static_points
    if len(points) == 0:
        points, colors = random_points(points, max_count, generator), None
    chosen = subsample(points, max_count, generator)
    points = points[chosen]
    if colors is not None:
        return points, colors[chosen].float() / 255.0
    seen = []
    for frame in views.frames(evenly_spaced_indices(len(views), MAX_COLOR_VIEWS)):
        mask = frame.static_mask
        if mask is None or capture.assumption == "dynamic":
            mask = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        seen.append((frame.camera, frame.image, mask))
    return points, color_points(points, seen)


def can_fit_motion(capture: Capture, views: Views, alignments: Float[Tensor, "T 2"], deformation: nn.Module) -> bool:
    """Whether a deformation has parameters to fit to what moves, and masks and depth show that."""
    has_parameters = bool(list(deformation.parameters()))
    return has_parameters and capture.assumption == "masks" and is_depth_known(views, alignments)


class DynamicStart(NamedTuple):
    """The dynamic Gaussians that stage I starts from.

    Attributes:
        gaussians: The Gaussians.
        lacks_fit: Whether the deformation was to be fitted to what moves, but does not follow it.
        num_tracks: Number of tracks that it follows.
    """

    gaussians: Gaussians
    lacks_fit: bool = False
    num_tracks: int = 0


@torch.no_grad()
def dynamic_gaussians(
    config: TrainConfig,
    capture: Capture,
    views: SomeViews,
    alignments: Float[Tensor, "T 2"],
    deformation: nn.Module,
    generator: torch.Generator,
    is_stopped: IsStopped = never,
) -> DynamicStart | None:
    """Dynamic Gaussians at dynamic pixels, unprojected by aligned depth, to which the deformation may be fitted first.

    Without depth they start in front of the points around them, without visible points at random positions in the
    scene's box, and at the sparse points if everything is assumed to be dynamic. If nothing is dynamic, there are none.
    What was tracked starts on its tracks. The deformation is fitted unless ``schedule.fit_motion`` is 0, as in plans
    where it cannot be. The result is None, and the deformation as it was, if ``is_stopped`` says during the fit that it
    is to stop.
    """
    if isinstance(deformation, SplineDeformation):
        tracks = find_tracks(capture, views)
        return DynamicStart(start_from_tracks(tracks, deformation, config, capture.view_size, generator))
    if capture.assumption == "dynamic" and len(capture.points):
        return DynamicStart(_gaussians_at_points(config, capture, views, generator))
    count = max(config.model.dynamic_points, MAX_POINTS * (config.schedule.fit_motion > 0))
    found = unproject_pixels(capture, views, alignments, lambda view: ~view.static_mask, count, generator)
    if found is None:
        return DynamicStart(Gaussians.empty(0, config.model.sh_degree))
    if not (config.schedule.fit_motion and found.depth_known):
        gaussians = _gaussians_at_dynamic_points(config, capture, found, generator)
        return DynamicStart(gaussians, lacks_fit=config.schedule.fit_motion > 0)
    observed = _observed(capture, views, alignments, found)
    fit = fit_motion(deformation, observed, config, generator, is_stopped)
    if fit is None:
        return None
    gaussians = _gaussians_at_dynamic_points(config, capture, fit.points, generator)
    return DynamicStart(gaussians, fit.points is observed.points, fit.num_tracks)


def _observed(capture: Capture, views: SomeViews, alignments: Float[Tensor, "T 2"], found: DynamicPoints) -> Observed:
    """What a deformation is fitted to: points, and tracks if the capture has some on what moves.

    Without tracks, which are of one view each, the points of all views at one time are compared together: cameras
    around an object show all of its sides.
    """
    times = torch.tensor([capture.cameras[name].time for name in capture.train], dtype=torch.float32)
    if capture.tracks is not None:
        paths = dynamic_paths(capture.tracks, list(capture.train), views, alignments)
        return Observed(found, times, capture.view_size, paths)
    moments, moment = times.unique(return_inverse=True)
    return Observed(found._replace(views=moment[found.views]), moments, capture.view_size)


def _gaussians_at_dynamic_points(
    config: TrainConfig, capture: Capture, found: DynamicPoints, generator: torch.Generator
) -> Gaussians:
    """Gaussians at a random subset of points; in the scene's box if none is left."""
    max_count = config.model.dynamic_points
    found = found.chosen(subsample(found.positions, max_count, generator))
    if len(found.positions) == 0:
        return gaussians_in_box(capture, max_count, config, generator)
    largest = math.inf if found.depth_known else MAX_SCALE * capture.view_size
    return gaussians_at(found.positions, found.colors, config.model.sh_degree, largest)
