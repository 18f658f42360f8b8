"""Camera frustums in the scene of a browser."""

from collections.abc import Callable
from functools import partial

import numpy as np
import viser

from .panel import Panel
from .pose import Pose
from .training_cameras import TrainingCameras

BLUE, ORANGE = (90, 160, 255), (255, 160, 60)
LINE_PIXELS = 1.5

FRUSTUMS = "/training"
"""Path of the training cameras in the scene."""


def add_frustum(
    scene: viser.SceneApi,
    name: str,
    pose: Pose,
    aspect: float,
    scale: float,
    color: tuple[int, int, int],
    image: np.ndarray | None = None,
) -> viser.CameraFrustumHandle:
    """Adds the frustum of a camera to the scene.

    Args:
        scene: Scene of a browser.
        name: Path of the frustum in the scene.
        pose: The camera.
        aspect: Width over height of its image.
        scale: Size of the frustum [scene units].
        color: 8-bit RGB of the lines.
        image: Image on the far plane.
    """
    return scene.add_camera_frustum(
        name,
        pose.fov,
        aspect,
        scale=scale,
        thickness=LINE_PIXELS,
        thickness_units="screen",
        color=color,
        image=image,
        wxyz=np.array(pose.wxyz),
        position=np.array(pose.position),
        cast_shadow=False,
        receive_shadow=False,
    )


def show_training(
    scene: viser.SceneApi, training: TrainingCameras, look_through: Callable[..., None], panel: Panel
) -> None:
    """Adds the training cameras to the scene, or removes them, as the checkbox of the panel is set by now.

    Args:
        scene: Scene of a browser.
        training: The training cameras.
        look_through: Called with the index of a camera that is clicked, and the event.
        panel: Panel of the browser; the checkbox may change meanwhile, as images are read.
    """
    for index in training.frustums():
        if not panel.show_cameras.value:
            break
        view, image = training.views[index], training.thumbnail(index)
        name, scale = f"{FRUSTUMS}/{index}", training.frustum_scale
        add_frustum(scene, name, view.pose, view.aspect, scale, BLUE, image).on_click(partial(look_through, index))
    if not panel.show_cameras.value:
        for index in training.frustums():
            scene.remove_by_name(f"{FRUSTUMS}/{index}")
