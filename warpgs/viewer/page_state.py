"""What a browser shows, which survives a reload of its page."""

from typing import Any, NamedTuple

import numpy as np

from warpgs.editing.options import Edits

from .browser_camera import BrowserCamera
from .panel import Panel
from .path_editor import PathEditor, PathState
from .pose import Pose
from .steering import Steering

KEPT = ("time", "speed", "follow", "layer", "residual", "width")
"""Controls whose values survive a reload."""


class PageState(NamedTuple):
    """What a browser shows.

    Attributes:
        camera: Its camera.
        orientation: Quaternion of the camera, with its roll.
        controls: Values of the controls of the panel, by name.
        training_view: Number of the training camera that the slider selects, from 1; None without training cameras.
        path: Its keyframes.
        edits: Its edits.
    """

    camera: BrowserCamera
    orientation: np.ndarray
    controls: dict[str, Any]
    training_view: int | None
    path: PathState
    edits: Edits

    @property
    def pose(self) -> Pose:
        """The pose of the camera."""
        return Pose(tuple(self.orientation.tolist()), tuple(self.camera.position.tolist()), self.camera.fov)

    @staticmethod
    def of(steering: Steering, panel: Panel, has_training_cameras: bool, path: PathEditor, edits: Edits) -> "PageState":
        """The current state of a page."""
        controls = {name: getattr(panel, name).value for name in KEPT}
        training_view = panel.view.value if has_training_cameras else None
        return PageState(steering.seen(), steering.orientation, controls, training_view, path.state(), edits)
