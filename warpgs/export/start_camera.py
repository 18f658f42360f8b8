"""Cameras of an export: those of the run's capture, or default ones if the capture cannot be opened."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import Color
from warpgs.data.capture import COLORS, Capture, background_color
from warpgs.formats.cloud import Cloud
from warpgs.video import camera_paths
from warpgs.video.camera_paths import UP
from warpgs.video.filmed import Filmed
from warpgs.video.orientation import vertical

from .clouds import Clouds


@dataclass(frozen=True)
class StartView:
    """How a page starts.

    Attributes:
        title: Title of the page.
        size: (width, height) of the image that ``intrinsics`` refer to [px].
        intrinsics: fx, fy, cx, cy [px].
        viewmat: [4, 4] world to camera, of the first view without a track, and of the upward direction.
        pivot: Distance from the camera to the point that it orbits: median depth of the dynamic Gaussians in its image,
            or of all in it if there are none [scene units].
        track: One [4, 4] world to camera per key time, along the training cameras; empty without a path.
        seconds: Duration of the scene [s].
        antialias, max_alpha: As in ``RenderSettings``.
        background: Colour behind everything, in [0, 1].
        up: Upward direction of the room, for headsets [scene coordinates].
        metres: Metres per scene unit; None if that is not known.
        filmed: What the training cameras have filmed; None if they are not known.
    """

    title: str
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    viewmat: list[list[float]]
    pivot: float
    track: list[list[list[float]]]
    seconds: float
    antialias: bool
    max_alpha: float
    background: Color = COLORS["black"]
    up: tuple[float, ...] = UP
    metres: float | None = None
    filmed: Filmed | None = None


def start_view(clouds: Clouds, capture: Capture | None, keys: int, seconds: float) -> StartView:
    """How a page starts: along the training cameras, unless they jump; then the middle view, else a default camera.

    Args:
        clouds: The scene.
        capture: Capture of the run, if there is one.
        keys: Number of key times.
        seconds: Duration of the scene [s].
    """
    cloud = clouds.at(0.5)
    cloud = cloud.select(cloud.finite)
    track: list[Camera] = []
    camera = camera_paths.default_camera(camera_paths.BoundingSphere.around(_means(cloud)))
    filmed, up, metres = None, UP, None
    if capture is not None:
        track = [] if camera_paths.jumps(capture) else camera_paths.training_path(capture, keys)
        camera = track[len(track) // 2] if track else capture.cameras[camera_paths.middle_view(capture)].pinhole
        filmed, up, metres = Filmed.by(capture, _means(cloud)), tuple(vertical(capture).tolist()), capture.metres
    K = camera.K.tolist()
    dynamic = cloud.select(cloud.is_dynamic)
    config = clouds.scene.config
    return StartView(
        title=config.out.resolve().name if config.out else "scene",
        size=camera.size,
        intrinsics=(K[0][0], K[1][1], K[0][2], K[1][2]),
        viewmat=camera.viewmat.tolist(),
        pivot=camera_paths.focus(camera, _means(dynamic), _means(cloud)),
        track=[c.viewmat.tolist() for c in track],
        seconds=seconds,
        antialias=config.antialias,
        max_alpha=config.max_alpha,
        background=background_color(config.background),
        up=up,
        metres=metres,
        filmed=filmed,
    )


def _means(cloud: Cloud) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(cloud.means))
