"""Where a page begins: at the filming camera of the run's capture, or at a guess where the capture is not at hand."""

import numpy as np
import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.runs.run import Run
from warpgs.video import camera_paths

from .cloud import Cloud
from .clouds import Clouds
from .page import Start

SIDES = ((0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0))
"""From where guessed cameras look, as directions of x and z."""

WEIGHING_CAMERAS = 24


def find_capture(run: Run, quiet: bool) -> tuple[Capture | None, str]:
    """The capture of a run, if it can be had, and a line about it."""
    try:
        capture = run.open_capture(quiet)
    except (ValueError, OSError) as error:
        return None, f"the cameras are guessed, because the capture is not at hand: {error}"
    return capture, f"the cameras are those of {capture.name}"


def weighing_cameras(clouds: Clouds, capture: Capture | None) -> list[Camera]:
    """Some of the cameras that filmed, over all of the time; else guessed ones from four sides."""
    if capture is not None:
        names = sorted(capture.train, key=lambda name: capture.cameras[name].time)
        fractions = camera_paths.evenly_spaced(min(len(names), WEIGHING_CAMERAS))
        chosen = [names[round(fraction * (len(names) - 1))] for fraction in fractions]
        return [capture.cameras[name] for name in chosen]
    times = camera_paths.evenly_spaced(WEIGHING_CAMERAS)
    scene = camera_paths.BoundingSphere.around(_means(clouds.at(0.5)))
    return [camera_paths.default_camera(scene, SIDES[k % len(SIDES)], time) for k, time in enumerate(times)]


def opening(clouds: Clouds, capture: Capture | None, keys: int, seconds: float) -> Start:
    """How a page of a run begins."""
    cloud = _finite(clouds.at(0.5))
    track: list[Camera] = []
    camera = camera_paths.default_camera(camera_paths.BoundingSphere.around(_means(cloud)))
    if capture is not None:
        names = capture.val or capture.train
        camera, track = capture.cameras[names[len(names) // 2]], camera_paths.training_path(capture, keys)
    K = camera.K.tolist()
    moving = cloud.select(cloud.is_dynamic) if cloud.is_dynamic.any() else cloud
    return Start(
        title=clouds.scene.config.out.resolve().name if clouds.scene.config.out else "scene",
        size=camera.size,
        intrinsics=(K[0][0], K[1][1], K[0][2], K[1][2]),
        viewmat=camera.viewmat.tolist(),
        pivot=camera_paths.focus(camera, _means(moving)),
        track=[c.viewmat.tolist() for c in track],
        seconds=seconds,
        antialias=clouds.scene.config.antialias,
    )


def _finite(cloud: Cloud) -> Cloud:
    return cloud.select(cloud.finite)


def _means(cloud: Cloud) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(cloud.means))
