"""The dynamic Gaussians that stage I starts from, of each segment of time."""

import dataclasses
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.model.gaussians import Gaussians
from warpgs.model.segmented_deformation import SegmentedDeformation
from warpgs.model.segments import window
from warpgs.views.part import Part
from warpgs.views.views import Views

from .initialize import DynamicStart, dynamic_gaussians
from .motion_fit import IsStopped, never


def dynamic_start(
    config: TrainConfig,
    capture: Capture,
    views: Views,
    alignments: Float[Tensor, "T 2"],
    deformation: nn.Module,
    generator: torch.Generator,
    is_stopped: IsStopped = never,
) -> DynamicStart | None:
    """``dynamic_gaussians``, of several segments each by its own views and their times in its window."""
    if not isinstance(deformation, SegmentedDeformation):
        return dynamic_gaussians(config, capture, views, alignments, deformation, generator, is_stopped)

    def is_stopped_in(segment: int, done: float) -> bool:
        return is_stopped((segment + done) / deformation.num)

    found, networks = [], [deformation.of(segment) for segment in range(deformation.num)]
    for segment, network in enumerate(networks):
        part, indices = _part(capture, segment, deformation.num)
        if not indices:
            found.append(DynamicStart(Gaussians.empty(0, config.model.sh_degree)))
            continue
        sources = (config, part, Part(views, indices), alignments[indices], network, generator)
        start = dynamic_gaussians(*sources, partial(is_stopped_in, segment))
        if start is None:
            return None
        found.append(start)
    for segment, network in enumerate(networks):
        deformation.replace(segment, network)
    return _joined(found)


def _part(capture: Capture, segment: int, num: int) -> tuple[Capture, list[int]]:
    """The training frames in the window of a segment with their times in it, and their indices."""
    start, end = window(segment, num)
    cameras = [capture.cameras[name] for name in capture.train]
    indices = [k for k, camera in enumerate(cameras) if start <= camera.time <= end]
    if not indices:
        return capture, []
    names = [capture.train[k] for k in indices]
    times = [(cameras[k].time - start) / (end - start) for k in indices]
    inside = {name: dataclasses.replace(capture.cameras[name], time=t) for name, t in zip(names, times, strict=True)}
    return capture.split(names, ()).with_cameras(inside), indices


def _joined(found: Sequence[DynamicStart]) -> DynamicStart:
    for segment, start in enumerate(found):
        num, device = len(start.gaussians), start.gaussians.means.device
        start.gaussians.segments = torch.full((num,), segment, dtype=torch.int64, device=device)
    gaussians = found[0].gaussians
    for start in found[1:]:
        gaussians.append(start.gaussians)
    return DynamicStart(gaussians, any(s.lacks_fit for s in found), sum(s.num_tracks for s in found))
