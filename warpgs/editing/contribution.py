"""How much every Gaussian contributes to the images of cameras: the sum of its blend weights."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.config import RenderSettings
from warpgs.data.capture import Capture
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.model.scene import SplitScene
from warpgs.model.splats import Splats
from warpgs.rendering import render
from warpgs.runs.trained import TrainedScene
from warpgs.video import camera_paths

NUM_CAMERAS = 24
"""Number of cameras that contributions are measured with."""

SIDES = ((0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0))
"""Sides that default cameras look from, as directions (x, z)."""


class Contribution(NamedTuple):
    """Contributions of N Gaussians, static ones first [px].

    Attributes:
        total: [N] over all images, ``as_if_always_there``.
        largest: [N] in the image in which it is largest.
    """

    total: Float[Tensor, " N"]
    largest: Float[Tensor, " N"]


@torch.no_grad()
def blend_weights_in(splats: Splats, camera: Camera, settings: RenderSettings) -> Float[Tensor, " N"]:
    """Sum of alpha times transmittance of every Gaussian over the joint image of a camera [px]."""
    weights = render(splats, camera, settings=replace(settings, statistics=True)).weights
    assert weights is not None
    return weights


def as_if_always_there(weights: Float[Tensor, " N"], scene: SplitScene) -> Float[Tensor, " N"]:
    """Blend weights, summed over images of all times, of dynamic Gaussians as if they were there at all times.

    One of K segments of time is there in a K-th of the images. By the plain sum, what moves in a long video would look
    weaker than what stands still.
    """
    static, dynamic = weights.split([len(scene.static), len(scene.dynamic)])
    return torch.cat([static, scene.num_segments * dynamic])


def contribution(scene: TrainedScene, cameras: Sequence[Camera], quiet: bool = True) -> Contribution:
    """The contributions of the Gaussians of a scene to the images of cameras, each at its own time."""
    number = len(scene.scene.static) + len(scene.scene.dynamic)
    total, largest = torch.zeros(2, number, dtype=torch.float32, device=scene.device)
    for camera in progress(cameras, "measuring contributions", quiet):
        camera = camera.to(scene.device)
        splats = scene.splats(camera.time, camera=camera)
        weights = blend_weights_in(splats, camera, scene.config.render_settings)
        total, largest = total + weights, largest.maximum(weights)
    return Contribution(as_if_always_there(total, scene.scene), largest)


def weakest(weights: Float[Tensor, " N"], fraction: float) -> Bool[Tensor, " N"]:
    """Which Gaussians have the smallest weights, which together hold at most a fraction, in [0, 1), of all.

    If none has any weight, none is: what no view shows may still be shown later.
    """
    ascending, order = weights.double().sort()
    is_weak = torch.zeros_like(weights, dtype=torch.bool)
    total = ascending.sum()
    is_weak[order[(ascending.cumsum(0) <= fraction * total) & (total > 0)]] = True
    return is_weak


def sample_cameras(scene: TrainedScene, capture: Capture | None) -> list[Camera]:
    """Training cameras, evenly spaced in the order of time; without a capture, default cameras from four sides."""
    if capture is not None:
        names = capture.in_time(capture.train)
        return [capture.cameras[names[k]] for k in evenly_spaced_indices(len(names), NUM_CAMERAS)]
    sphere = camera_paths.BoundingSphere.around(scene.splats(0.5).means.cpu())
    times = camera_paths.evenly_spaced(NUM_CAMERAS)
    return [camera_paths.default_camera(sphere, SIDES[k % len(SIDES)], time) for k, time in enumerate(times)]
