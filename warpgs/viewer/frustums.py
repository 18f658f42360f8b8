"""Camera frustums in the scene of a browser."""

import numpy as np
import viser

from .pose import Pose

BLUE, ORANGE = (90, 160, 255), (255, 160, 60)
LINE_PIXELS = 1.5


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
