"""Trained scenes for measurements: of run folders, and of files of Gaussians."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.model.splats import Splats
from warpgs.ops.sh import num_bases
from warpgs.runs.opening import open_scene
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene
from warpgs.video.camera_paths import DEFAULT_FOCAL, DEFAULT_SIZE, UP, BoundingSphere, evenly_spaced, filling

from .scenes import Views

NUM_CAMERAS = 5

DISTANCE = 1.25
"""Distance of the cameras on a circle from the center of the scene, in radii of the scene, which then fills the image;
the radius contains 98 % of its Gaussians."""

ELEVATION = math.radians(20.0)
"""Angle at which they look down [rad]."""


def trained_views(path: Path, sizes: Sequence[tuple[int, int]], device: str) -> Iterator[Views]:
    """The views of a trained scene at several (width, height).

    Raises:
        ValueError: As ``open_scene``, if the run has no checkpoint or its capture cannot be opened, or a file is
            damaged.
        OSError: If a file needs a package that is not installed.
    """
    run = open_scene(path, "cuda" if device == "cuda" else "cpu")
    scene = run.trained_scene()
    cameras = _training_cameras(run) if run.has_capture else circle(scene.splats(0.5).means.cpu())
    if not (run.has_capture or scene.varies):  # all views share the memory of one time
        cameras = [dataclasses.replace(camera, time=0.0) for camera in cameras]
    at_times = {camera.time: _plain(scene, camera.time) for camera in cameras}
    for size in sizes:
        fitted = [filling(camera, size).to(device) for camera in cameras]
        splats = [at_times[camera.time] for camera in cameras]
        yield Views(path.name, splats, fitted, scene.config.antialias)


def circle(means: Float[Tensor, "N 3"]) -> list[Camera]:
    """Cameras on a horizontal circle above most of a scene that look at its middle, at evenly spaced times."""
    sphere, cameras = BoundingSphere.around(means), []
    for k, time in enumerate(evenly_spaced(NUM_CAMERAS)):
        angle = 2.0 * math.pi * k / NUM_CAMERAS
        across, down = math.cos(ELEVATION), -math.sin(ELEVATION)
        side = torch.tensor([across * math.sin(angle), down, -across * math.cos(angle)], dtype=torch.float32)
        position, focal = sphere.center + DISTANCE * sphere.radius * side, DEFAULT_FOCAL * DEFAULT_SIZE[1]
        cameras.append(Camera.looking_at(position, sphere.center, UP, focal, DEFAULT_SIZE, time))
    return cameras


def _training_cameras(run: Run) -> list[Camera]:
    """Pinholes at evenly spaced training views, in their order."""
    capture = run.open_corrected_capture(quiet=True)
    last = len(capture.train) - 1
    chosen = dict.fromkeys(round(share * last) for share in evenly_spaced(NUM_CAMERAS))
    return [capture.cameras[capture.train[k]].pinhole for k in chosen]


def _plain(scene: TrainedScene, time: float) -> Splats:
    """The splats at a time, with the coefficients in use, on black and without reflections, as others render them."""
    splats = scene.splats(time)
    assert splats.sh is not None
    bases = splats.sh.shape[1] if splats.sh_degree is None else num_bases(splats.sh_degree)
    sh = splats.sh[:, :bases].contiguous()
    return dataclasses.replace(splats, sh=sh, sh_degree=None, background=None, reflections=None)
