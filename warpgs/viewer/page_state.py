"""What a browser shows, which survives a reload of its page."""

from typing import Any, NamedTuple

import numpy as np
import viser

from .browser_camera import BrowserCamera
from .panel import Panel
from .path_editor import PathEditor, PathState

KEPT = ("time", "speed", "layer", "residual", "width")
"""Controls whose values survive a reload."""


class PageState(NamedTuple):
    """What a browser shows.

    Attributes:
        camera: Its camera.
        orientation: Quaternion of the camera, with its roll.
        controls: Values of the controls of the panel, by name.
        training_view: Number of the training camera that the slider selects, from 1; None without training cameras.
        path: Its keyframes.
    """

    camera: BrowserCamera
    orientation: np.ndarray
    controls: dict[str, Any]
    training_view: int | None
    path: PathState

    @staticmethod
    def of(camera: viser.CameraHandle, panel: Panel, has_training_cameras: bool, path: PathEditor) -> "PageState":
        """The current state of a page."""
        seen = BrowserCamera(camera.position, camera.look_at, camera.up_direction, float(camera.fov))
        controls = {name: getattr(panel, name).value for name in KEPT}
        training_view = panel.view.value if has_training_cameras else None
        return PageState(seen, camera.wxyz, controls, training_view, path.state())
