"""Where a page begins: at the filming camera of the run's capture, or at a guess where the capture is not at hand."""

import numpy as np
import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.runs import run as runs
from warpgs.video import camera_paths as paths

from .cloud import Cloud
from .moments import Moments
from .page import Start

SIDES = ((0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0))
"""From where guessed cameras look, as directions of x and z."""

WEIGHING_CAMERAS = 24


def find_capture(moments: Moments, quiet: bool) -> tuple[Capture | None, str]:
    """The capture of a run, if it can be had, and a line about it."""
    try:
        capture = runs.open_capture(moments.config, quiet)
    except (ValueError, OSError) as error:
        return None, f"the cameras are guessed, because the capture is not at hand: {error}"
    return capture, f"the cameras are those of {capture.name}"


def weighing_cameras(moments: Moments, capture: Capture | None) -> list[Camera]:
    """Some of the cameras that filmed, over all of the time; else guessed ones from four sides."""
    if capture is not None:
        names = sorted(capture.train, key=lambda name: capture.cameras[name].time)
        chosen = [
            names[round(share * (len(names) - 1))] for share in paths.evenly_spaced(min(len(names), WEIGHING_CAMERAS))
        ]
        return [capture.cameras[name] for name in chosen]
    times = paths.evenly_spaced(WEIGHING_CAMERAS)
    scene = paths.Ball.around(_means(moments.at(0.5)))
    return [paths.default_camera(scene, SIDES[k % len(SIDES)], time) for k, time in enumerate(times)]


def opening(moments: Moments, capture: Capture | None, keys: int, seconds: float) -> Start:
    """How a page of a run begins."""
    cloud = _finite(moments.at(0.5))
    track: list[Camera] = []
    camera = paths.default_camera(paths.Ball.around(_means(cloud)))
    if capture is not None:
        names = capture.val or capture.train
        camera, track = capture.cameras[names[len(names) // 2]], paths.training_path(capture, keys)
    K = camera.K.tolist()
    moving = cloud.select(cloud.is_dynamic) if cloud.is_dynamic.any() else cloud
    return Start(
        title=moments.config.out.resolve().name if moments.config.out else "scene",
        size=camera.size,
        intrinsics=(K[0][0], K[1][1], K[0][2], K[1][2]),
        viewmat=camera.viewmat.tolist(),
        pivot=paths.focus(camera, _means(moving)),
        track=[c.viewmat.tolist() for c in track],
        seconds=seconds,
        antialias=moments.config.antialias,
    )


def _finite(cloud: Cloud) -> Cloud:
    return cloud.select(cloud.finite)


def _means(cloud: Cloud) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(cloud.means))
