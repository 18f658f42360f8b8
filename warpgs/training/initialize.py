"""The state that training starts from: initial Gaussians of both branches, and the alignment of monocular depth."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import LossConfig, RenderSettings, TrainConfig
from warpgs.data import depth_alignment
from warpgs.data.capture import Capture
from warpgs.data.sampling import evenly_spaced
from warpgs.model.gaussians import SH_C0, Gaussians
from warpgs.model.mlp_deformation import MlpDeformation
from warpgs.model.scene import SplitScene
from warpgs.model.spline_deformation import SplineDeformation
from warpgs.rendering import DEFAULTS, render
from warpgs.views.views import Views

from .density.reseed import gaussians_in_box
from .dynamic_points import MAX_SCALE, is_depth_known, unproject_pixels
from .losses import DepthTrust
from .motion_fit import MAX_POINTS, fit_motion
from .point_cloud import color_points, gaussians_at, random_points, scene_box, subsample
from .schedule import Protocol
from .tracked_start import start_from_tracks
from .tracks import find_tracks

MAX_COLOR_VIEWS = 12
"""Maximum number of training views that tell the colours of points without colours."""

RESOLUTION = 0.25
"""Distance of points, in pixels at the capture's median depth, below which clouds of several scans or models show one
place. A Gaussian as small as the error between the scans would be culled and pruned."""

MAX_SAMPLES_ON_CPU, MAX_SAMPLES_ON_GPU = 1 << 16, 1 << 20
"""Numbers of samples that are fitted at once: as many as fit into a CPU's cache, or as keep a GPU busy for longer than
it takes to launch its kernels."""


def initial_scene(config: TrainConfig, capture: Capture, generator: torch.Generator) -> SplitScene:
    """Static Gaussians at the sparse points (at random ones in the scene's box if there are none), no dynamic ones yet.

    If everything is assumed to be dynamic, there are no static Gaussians either.
    """
    center, half_size = scene_box(capture.points)
    degree = config.model.sh_degree
    static = Gaussians.empty(0, degree)
    if capture.assumption != "dynamic":
        static = _gaussians_at_points(config, capture, generator)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        scene = SplitScene(static, Gaussians.empty(0, degree), config.model, center, half_size)
    for module in scene.deformation.modules():
        if isinstance(module, MlpDeformation):
            module.units[:3] = config.length_unit(capture.view_size)
    return scene


def _gaussians_at_points(config: TrainConfig, capture: Capture, generator: torch.Generator) -> Gaussians:
    """Gaussians at a random subset of the capture's points; closer ones than its cameras resolve are at one place."""
    points, colors = _colored_points(config, capture, generator)
    focal = torch.stack([capture.cameras[name].focal for name in capture.train]).median()
    resolution = RESOLUTION * capture.median_depth / float(focal)
    return gaussians_at(points, colors, config.model, resolution=resolution)


def _colored_points(config: TrainConfig, capture: Capture, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A random subset of the capture's points with colours in [0, 1]; see ``model.point_colors``."""
    points, colors, max_count = capture.points, capture.point_colors, config.model.max_static_points
    if len(points) == 0:
        points, colors = random_points(points, max_count, generator), None
    chosen = subsample(points, max_count, generator)
    points = points[chosen]
    if config.model.point_colors == "grey":
        return points, 0.5 + SH_C0 / 255.0 * torch.rand(points.shape, dtype=torch.float32, generator=generator)
    if colors is not None:
        return points, colors[chosen].float() / 255.0
    views = []
    for name in evenly_spaced(capture.train, MAX_COLOR_VIEWS):
        frame = capture.frame(name)
        mask = frame.static_mask
        if mask is None or capture.assumption == "dynamic":
            mask = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        views.append((frame.camera, frame.image, mask))
    return points, color_points(points, views)


def fits_motion(config: TrainConfig, capture: Capture, views: Views, alignments: Float[Tensor, "T 2"]) -> bool:
    """Whether the deformation is fitted to points before stage I: where masks and depth show what moves."""
    return config.schedule.fit_motion > 0 and capture.assumption == "masks" and is_depth_known(views, alignments)


@torch.no_grad()
def dynamic_gaussians(
    protocol: Protocol,
    capture: Capture,
    views: Views,
    alignments: Float[Tensor, "T 2"],
    deformation: nn.Module,
    generator: torch.Generator,
    is_stopped: Callable[[], bool] = bool,
) -> Gaussians | None:
    """Dynamic Gaussians at dynamic pixels, unprojected by aligned depth, to which the protocol may fit the deformation.

    Without depth they start in front of the points around them, or, as ``model.dynamic_start`` says and without visible
    points, at random positions in the scene's box. If everything is assumed to be dynamic, they start at the sparse
    points. If nothing is dynamic, there are none. What was tracked starts on its tracks. The result is
    None, and the deformation as it was, if ``is_stopped`` says during the fit that it is to stop.
    """
    config = protocol.config
    max_count, degree = config.model.dynamic_points, config.model.sh_degree
    if isinstance(deformation, SplineDeformation):
        return start_from_tracks(find_tracks(capture), deformation, config, capture.view_size, generator)
    if capture.assumption == "dynamic" and len(capture.points):
        return _gaussians_at_points(config, capture, generator)
    count = max(max_count, MAX_POINTS) if protocol.fits_motion else max_count
    found = unproject_pixels(capture, views, alignments, lambda view: ~view.static_mask, count, generator)
    if found is None:
        return Gaussians.empty(0, degree)
    if protocol.fits_motion and found.depth_known:
        times = torch.tensor([capture.cameras[name].time for name in capture.train], dtype=torch.float32)
        fitted = fit_motion(deformation, found, times, capture.view_size, config, generator, is_stopped)
        if fitted is None:
            return None
        found = fitted
    found = found.chosen(subsample(found.positions, max_count, generator))
    is_uniform = config.model.dynamic_start == "uniform" and not found.depth_known
    if is_uniform or len(found.positions) == 0:
        return gaussians_in_box(capture, max_count, config, generator)
    largest = math.inf if found.depth_known else MAX_SCALE * capture.view_size
    return gaussians_at(found.positions, found.colors, config.model, largest)


class DepthAlignment(NamedTuple):
    """Alignment of each view's inverse depth to the sparse points.

    Attributes:
        alignments: [T, 2] scale and offset; NaN where the points do not determine them.
        errors: [T, 2] of aligned depth and of a constant depth; see ``depth_alignment.relative_errors``.
        plain_errors: [T] of aligned depth without the smooth factor.
    """

    alignments: Float[Tensor, "T 2"]
    errors: Float[Tensor, "T 2"]
    plain_errors: Float[Tensor, " T"]

    def trust(self, loss: LossConfig) -> DepthTrust:
        """How much each view's depth is trusted; views with too few points have the median error of the others."""
        errors = self.errors[:, 0]
        errors = torch.where(errors.isfinite(), errors, depth_alignment.typical_error(errors))
        weight = torch.ones_like(errors)
        if loss.depth_tolerance:
            refused = depth_alignment.is_unusable(self.errors)
            weight = torch.where(refused, 0.0, 1.0 / (1.0 + (errors / loss.depth_tolerance) ** 2))
        return DepthTrust(weight, loss.depth_margin * errors)


def require_no_depth(capture: Capture, views: Views) -> None:
    """Raises ValueError if a training view has depth: a capture is to be read without where the config is without."""
    for name, view in zip(capture.train, views, strict=True):
        if bool(view.inverse_depth.isfinite().any()):
            raise ValueError(
                f"{capture.name}: frame {name} was read with depth, but the config is without (depth=False); open the "
                "capture with open_capture(config)"
            )


@torch.no_grad()
def align_to_points(capture: Capture, views: Views, smooth: bool = False) -> DepthAlignment:
    """Aligns each view's inverse depth to the sparse points; metric depth stays as it is.

    Args:
        capture: The capture, with the points.
        views: Its training views.
        smooth: Whether to change the views' depth by a smooth factor as well, where that brings it nearer to points
            that were held out.
    """
    smooth = smooth and not capture.metric_depth
    alignments = torch.full((len(views), 2), torch.nan, dtype=torch.float32, device=views.device)
    errors = torch.full((len(views), 2), torch.inf, dtype=torch.float32, device=views.device)
    plain = errors[:, 0].clone()
    points = capture.points.to(views.device)
    for batch in _batches(views, len(points)):
        samples = []
        for view in views.each(batch):
            samples.append(depth_alignment.sample_points(view.inverse_depth, view.static_mask, view.camera, points))
        alignments[batch] = depth_alignment.align_to_points(samples, capture.metric_depth)
        for index, part in zip(batch, samples, strict=True):
            errors[index] = depth_alignment.relative_errors(part, alignments[index])
            plain[index] = errors[index, 0]
            if smooth and bool(errors[index].isfinite().all()) and not bool(depth_alignment.is_unusable(errors[index])):
                factor, error = depth_alignment.smooth_factor(part, alignments[index])
                if error < errors[index, 0]:
                    views.set_depth_factor(index, alignments[index], factor)
                    errors[index, 0] = error
    return DepthAlignment(alignments, errors, plain)


@torch.no_grad()
def align_to_rendering(
    alignments: Float[Tensor, "T 2"],
    views: Views,
    scene: SplitScene,
    sh_degree: int,
    settings: RenderSettings = DEFAULTS,
) -> Float[Tensor, "T 2"]:
    """Scale and offset against the rendered depth; views where they cannot be determined keep their alignment."""
    splats = scene.static_splats(sh_degree)
    settings = replace(settings, depth=True)
    found = []
    for batch in _batches(views, views.num_pixels // len(views)):
        samples = []
        for view in views.each(batch):
            layer = render(splats, view.camera, settings=settings).joint
            assert layer.depth is not None
            sources = view.inverse_depth, view.static_mask, layer.depth, layer.alpha
            samples.append(depth_alignment.sample_rendering(*sources))
        found.append(depth_alignment.fit_scale_offset(samples))
    aligned = torch.cat(found)
    return torch.where(aligned.isfinite(), aligned, alignments)


def _batches(views: Views, samples_per_view: int) -> list[list[int]]:
    """Indices of all views, divided into those that are fitted at once."""
    most = MAX_SAMPLES_ON_GPU if views.device.type == "cuda" else MAX_SAMPLES_ON_CPU
    indices = torch.arange(len(views)).split(max(1, most // max(1, samples_per_view)))
    return [batch.tolist() for batch in indices]
