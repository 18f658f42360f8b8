"""Cameras of a browser: the start camera, and the training cameras to look through."""

import math
from typing import NamedTuple

import numpy as np
import torch
import viser

from warpgs.video.camera_paths import UP, BoundingSphere, default_camera

from .pose import pose_of
from .source import Source
from .training_cameras import TrainingCameras
from .training_path import fitted


class BrowserCamera(NamedTuple):
    """A camera as a browser takes it.

    Attributes:
        position: Centre of the camera.
        target: Point straight ahead, which the mouse orbits.
        up: Upward direction of the world.
        fov: Vertical field of view [rad].
    """

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float


def through_training_camera(training: TrainingCameras, index: int, aspect: float = math.inf) -> BrowserCamera:
    """A training camera without its roll, in a canvas with an aspect of width over height.

    In a canvas that is narrower than its image, the field of view is wide enough to show the whole image.
    """
    view = training.views[index]
    position, target = np.array(view.pose.position), training.target(index)
    return BrowserCamera(position, target, training.up, fitted(view.pose.fov, view.aspect, aspect))


def start_camera(source: Source, training: TrainingCameras | None) -> BrowserCamera:
    """The middle training camera; without training cameras, a default camera that looks at the centre of the scene."""
    if training is not None:
        return through_training_camera(training, len(training.views) // 2)
    trained = None if source.follow else source.current()
    sphere = BoundingSphere(torch.zeros(3, dtype=torch.float32), 1.0)
    if trained is not None:
        means = torch.cat([trained.scene.static.means, trained.scene.dynamic.means]).detach().cpu()
        sphere = BoundingSphere.around(means) if len(means) else sphere
    camera = default_camera(sphere)
    position, target = camera.position.double().numpy(), sphere.center.double().numpy()
    return BrowserCamera(position, target, np.array(UP), pose_of(camera).fov)


def set_camera(handle: viser.CameraHandle, camera: BrowserCamera) -> None:
    """Moves a browser's camera."""
    handle.fov = camera.fov
    handle.up_direction = camera.up
    handle.position = camera.position
    handle.look_at = camera.target
