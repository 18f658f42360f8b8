"""The path of the training camera, which the view follows."""

import math

from warpgs.data.capture import Capture
from warpgs.video import camera_paths

from .pose import Pose, pose_of

FRAMES = 241
"""Cameras that the path is smoothed over and interpolated between."""


class TrainingPath:
    """The smoothed path of the training camera of a capture."""

    def __init__(self, capture: Capture) -> None:
        self._cameras = camera_paths.training_path(capture, FRAMES)

    @staticmethod
    def of(capture: Capture) -> "TrainingPath | None":
        """The path; None if the camera jumps from frame to frame, so that nobody could watch it."""
        return None if camera_paths.jumps(capture) else TrainingPath(capture)

    def pose(self, time: float, aspect: float) -> Pose:
        """The pose at a time in [0, 1], which shows the whole image in a canvas with an aspect of width over height."""
        place = time * (FRAMES - 1)
        before = min(int(place), FRAMES - 2)
        (camera,) = camera_paths.interpolated(self._cameras[before : before + 2], [0.0, 1.0], [place - before])
        pose = pose_of(camera)
        return pose._replace(fov=fitted(pose.fov, camera.width / camera.height, aspect))


def fitted(fov: float, own: float, aspect: float) -> float:
    """The vertical field of view [rad] that shows a whole image in a canvas.

    Args:
        fov: Vertical field of view of the image [rad].
        own: Width over height of the image.
        aspect: Width over height of the canvas; in a narrower one, the field of view is wider.
    """
    return 2.0 * math.atan(max(1.0, own / aspect) * math.tan(0.5 * fov))
