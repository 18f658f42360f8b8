"""The alignment of the views' depth to the scene, and how much it is trusted."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import LossConfig, RenderSettings
from warpgs.data import depth_alignment
from warpgs.data.capture import Capture
from warpgs.data.depth_alignment import PointSamples
from warpgs.model.scene import SplitScene
from warpgs.rendering import DEFAULTS, render
from warpgs.views.views import MANY, Views

MAX_SAMPLES_ON_CPU, MAX_SAMPLES_ON_GPU = 1 << 16, 1 << 20
"""Numbers of samples that are fitted at once: as many as fit into a CPU's cache, or as keep a GPU busy for longer than
it takes to launch its kernels."""

MAX_RENDERED = 1 << 15
"""Maximum number of pixels of each view that are compared with the rendered depth, where there are many views."""

MARGIN = 3.0
"""Errors of the static depth up to this many times the relative error of the view's aligned depth at the sparse points
are not penalized where depth has a tolerance (``LossConfig.depth_tolerance``)."""


class DepthTrust(NamedTuple):
    """How much the aligned depth of views is trusted, by its error at the sparse points.

    Attributes:
        weight: Factor of the terms of depth, in [0, 1]; 0 = the depth is not used. See ``LossConfig.depth_tolerance``.
        margin: Relative error of the static depth that is not penalized. See ``MARGIN``.
    """

    weight: Float[Tensor, "*T"]
    margin: Float[Tensor, "*T"]


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
            return DepthTrust(weight, MARGIN * errors)
        return DepthTrust(weight, torch.zeros_like(errors))


def require_no_depth(capture: Capture, views: Views) -> None:
    """Raises ValueError if a training view has depth: a capture is to be read without where the config is without."""
    for name, glance in zip(capture.train, views.glances, strict=True):
        if glance.has_depth:
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
    known = [index for index, glance in enumerate(views.glances) if glance.has_depth]
    for batch in _batches(views, len(points), known):
        samples = []
        for view in views.each(batch):
            samples.append(depth_alignment.sample_points(view.inverse_depth, view.static_mask, view.camera, points))
        alignments[batch] = depth_alignment.align_to_points(samples, capture.metric_depth)
        for index, part in zip(batch, samples, strict=True):
            errors[index] = depth_alignment.relative_errors(part, alignments[index])
        plain[batch] = errors[batch, 0]
        if smooth:
            errors[batch, 0] = _smooth(views, dict(zip(batch, samples, strict=True)), alignments, errors)
    return DepthAlignment(alignments, errors, plain)


def _smooth(
    views: Views, samples: Mapping[int, PointSamples], alignments: Float[Tensor, "T 2"], errors: Float[Tensor, "T 2"]
) -> Float[Tensor, " V"]:
    """Changes the depth of views by a smooth factor where that helps, in threads; the errors of V views after that."""
    chosen = list(samples)
    is_smoothed = errors[chosen].isfinite().all(1) & ~depth_alignment.is_unusable(errors[chosen])
    before = dict(zip(chosen, errors[chosen, 0].tolist(), strict=True))

    def smoothed(index: int) -> float:
        factor, error = depth_alignment.smooth_factor(samples[index], alignments[index])
        if error >= before[index]:
            return before[index]
        views.set_depth_factor(index, alignments[index], factor)
        return error

    smoothable = [index for index, asked in zip(chosen, is_smoothed.tolist(), strict=True) if asked]
    after = before | dict(zip(smoothable, views.in_threads(smoothed, smoothable), strict=True))
    return errors.new_tensor([after[index] for index in chosen])


@torch.no_grad()
def align_to_rendering(
    alignments: Float[Tensor, "T 2"],
    views: Views,
    scene: SplitScene,
    sh_degree: int,
    settings: RenderSettings = DEFAULTS,
) -> Float[Tensor, "T 2"]:
    """Scale and offset against the rendered depth; views where they cannot be determined keep their alignment.

    Of more than ``MANY`` views a part of the rows and columns is compared.
    """
    splats, settings = scene.static_splats(sh_degree), replace(settings, depth=True)
    found, pixels = [], views.num_pixels // len(views)
    step = math.ceil(math.sqrt(pixels / MAX_RENDERED)) if len(views) > MANY else 1
    for batch in _batches(views, pixels // step**2, range(len(views))):
        samples = []
        for view in views.each(batch):
            layer = render(splats, view.camera, settings=settings).joint
            assert layer.depth is not None
            sources = view.inverse_depth, view.static_mask, layer.depth, layer.alpha
            samples.append(depth_alignment.sample_rendering(*(values[::step, ::step] for values in sources)))
        found.append(depth_alignment.fit_scale_offset(samples))
    aligned = torch.cat(found)
    return torch.where(aligned.isfinite(), aligned, alignments)


def _batches(views: Views, samples_per_view: int, chosen: Sequence[int]) -> list[list[int]]:
    """Indices of some views, divided into those that are fitted at once."""
    most = MAX_SAMPLES_ON_GPU if views.device.type == "cuda" else MAX_SAMPLES_ON_CPU
    count = max(1, most // max(1, samples_per_view))
    return [[*chosen[first : first + count]] for first in range(0, len(chosen), count)]
