"""The training cameras of a run and their images."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.video.camera_paths import focus, upward
from warpgs.video.filmed import Filmed
from warpgs.visualize.images import reduced

from .pose import Pose, pose_of
from .training_path import TrainingPath

THUMBNAIL_WIDTH = 320
MAX_FRUSTUMS = 48
"""Maximum number of cameras to show in the scene; the slider has all."""

FRUSTUM_SCALE, MIN_FRUSTUM_SCALE = 0.088, 0.004
"""Size of a camera in the scene, relative to the radius of the cameras' path, along which they would hide each other if
their size were relative to the scene's; and its minimum relative to the median depth, for cameras that stand still."""


class TrainingCamera(NamedTuple):
    """One training view.

    Attributes:
        name: Id of the view.
        pose: Its camera.
        time: Its time in [0, 1].
        aspect: Width over height of its image.
    """

    name: str
    pose: Pose
    time: float
    aspect: float


class TrainingCameras:
    """The training views of a capture, in the order of their times; images are read on first use.

    Args:
        capture: The capture.
        clouds: Points of the scene, for ``Filmed.by``.

    Attributes:
        capture: The capture.
        views: The views.
        path: The path of the training camera; None if it jumps from frame to frame.
        filmed: What they have filmed.
    """

    def __init__(self, capture: Capture, *clouds: Float[Tensor, "_ 3"]) -> None:
        self.capture = capture
        self.views = []
        for name in capture.in_time(capture.train):
            camera = capture.cameras[name]
            self.views.append(TrainingCamera(name, pose_of(camera), camera.time, camera.width / camera.height))
        self.path, self.filmed = TrainingPath.of(capture), Filmed.by(capture, *clouds)
        self.thumbnail = lru_cache(maxsize=256)(self._thumbnail)

    @property
    def up(self) -> np.ndarray:
        """Mean upward direction of the cameras; a capture has no other."""
        return upward(self.capture).numpy()

    @property
    def frustum_scale(self) -> float:
        """Size of the cameras in the scene [scene units]."""
        return max(FRUSTUM_SCALE * self.capture.path_radius, MIN_FRUSTUM_SCALE * self.capture.median_depth)

    def target(self, index: int) -> np.ndarray:
        """The point straight ahead of a view, at the median depth of the points of the capture that it sees."""
        camera = self.capture.cameras[self.views[index].name]
        return (camera.position + focus(camera, self.capture.points) * camera.viewmat[2, :3]).double().numpy()

    def camera(self, index: int) -> Camera:
        """The camera of a view."""
        return self.capture.cameras[self.views[index].name]

    @property
    def times(self) -> list[float]:
        """All times of the views, in order."""
        return sorted({view.time for view in self.views})

    def image(self, index: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """The image of a view; None if it cannot be read."""
        try:
            return self.capture.frame(self.views[index].name).image.numpy()
        except (ValueError, OSError):
            return None

    def frustums(self) -> list[int]:
        """Indices of the views to show in the scene."""
        return evenly_spaced_indices(len(self.views), MAX_FRUSTUMS)

    def _thumbnail(self, index: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """The image of a view, scaled down; None if it cannot be read."""
        image = self.image(index)
        return None if image is None else reduced(image, THUMBNAIL_WIDTH)
