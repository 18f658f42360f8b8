"""The cameras that a run was trained with, and their pictures."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from warpgs.data.capture import Capture
from warpgs.video.camera_paths import focus, upward

from .pose import Pose, pose_of

PICTURE_WIDTH = 320
MAX_FRUSTUMS = 48
"""Cameras to draw into the scene, at most; the slider has them all."""

FRUSTUM_SCALE = 0.08
"""Size of a camera in the scene, as a share of the capture's extent."""


class TrainingCamera(NamedTuple):
    """One training view.

    Attributes:
        aspect: Width over height of its picture.
    """

    name: str
    pose: Pose
    time: float
    aspect: float


class TrainingCameras:
    """The training views of a capture, in order of time; pictures are read when they are asked for."""

    def __init__(self, capture: Capture) -> None:
        names = sorted(capture.train, key=lambda name: (capture.cameras[name].time, name))
        self._capture = capture
        self.views = []
        for name in names:
            camera = capture.cameras[name]
            self.views.append(TrainingCamera(name, pose_of(camera), camera.time, camera.width / camera.height))
        self.picture = lru_cache(maxsize=256)(self._picture)

    @property
    def up(self) -> np.ndarray:
        """Mean upward direction of the cameras, which nobody else knows in a capture."""
        return upward(self._capture).numpy()

    @property
    def frustum_scale(self) -> float:
        """Size to draw the cameras at [scene units]."""
        return FRUSTUM_SCALE * self._capture.extent

    def ahead(self, number: int) -> np.ndarray:
        """The point straight ahead of a view, as far away as the middle of the capture's points that it sees."""
        camera = self._capture.cameras[self.views[number].name]
        return (camera.position + focus(camera, self._capture.points) * camera.viewmat[2, :3]).double().numpy()

    def spread(self) -> list[int]:
        """Numbers of the views to draw into the scene."""
        last = len(self.views) - 1
        count = min(MAX_FRUSTUMS, len(self.views))
        return sorted({round(k * last / max(1, count - 1)) for k in range(count)})

    def _picture(self, number: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """A view's picture, small; None if it can't be read."""
        try:
            image = self._capture.frame(self.views[number].name).image.numpy()
        except (ValueError, OSError):
            return None
        height, width = image.shape[:2]
        if width <= PICTURE_WIDTH:
            return image
        size = (PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width)))
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
