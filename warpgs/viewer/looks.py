"""Where a browser's camera looks, and what its mouse turns around."""

import math
from typing import NamedTuple

import numpy as np
import torch
import viser

from warpgs.video.camera_paths import UP, BoundingSphere, default_camera

from .pose import pose_of
from .source import Source
from .training_cameras import TrainingCameras


class Look(NamedTuple):
    """A camera of the browser.

    Attributes:
        target: Point ahead of it, which its mouse turns around.
        up: Upward direction of the world.
        fov: Vertical field of view [rad].
    """

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float


def look_through(training: TrainingCameras, number: int, aspect: float = math.inf) -> Look:
    """A training camera, but for its roll.

    Args:
        training: All of them.
        number: Which.
        aspect: Width over height of the canvas; if that is narrower than the camera's picture, the field of view is
            as much larger as it takes to have the whole picture in it.
    """
    view = training.views[number]
    widened = max(1.0, view.aspect / aspect) * math.tan(0.5 * view.pose.fov)
    return Look(np.array(view.pose.position), training.ahead(number), training.up, 2.0 * math.atan(widened))


def first_look(source: Source, training: TrainingCameras | None) -> Look:
    """The middle training camera; without any, a look at the middle of the scene."""
    if training is not None:
        return look_through(training, len(training.views) // 2)
    trained = None if source.follow else source.current()
    ball = BoundingSphere(torch.zeros(3), 1.0)
    if trained is not None:
        means = torch.cat([trained.scene.static.means, trained.scene.dynamic.means]).detach().cpu()
        ball = BoundingSphere.around(means) if len(means) else ball
    camera = default_camera(ball)
    position, target = camera.position.double().numpy(), ball.center.double().numpy()
    return Look(position, target, np.array(UP), pose_of(camera).fov)


def aim(camera: viser.CameraHandle, look: Look) -> None:
    """Points a browser's camera."""
    camera.fov = look.fov
    camera.up_direction = look.up
    camera.position = look.position
    camera.look_at = look.target
