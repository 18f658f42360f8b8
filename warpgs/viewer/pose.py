"""Conversion between cameras and browser poses (orientation, position, vertical field of view)."""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from warpgs.cameras import Camera, intrinsic_matrix

Vector = tuple[float, ...]


class Pose(NamedTuple):
    """The pose of a browser's camera, with OpenCV axes.

    Attributes:
        wxyz: Quaternion of the rotation from the camera to the world.
        position: Centre of the camera [scene units].
        fov: Vertical field of view [rad].
    """

    wxyz: Vector
    position: Vector
    fov: float


def camera_of(pose: Pose, size: tuple[int, int], time: float) -> Camera:
    """The camera of a pose, with the principal point in the middle of an image of (width, height) [px].

    Raises:
        ValueError: If the pose is not finite, its rotation is zero or its field of view is not in (0, π).
    """
    w, x, y, z = pose.wxyz
    if not all(map(math.isfinite, (*pose.wxyz, *pose.position))) or not any(pose.wxyz) or not 0 < pose.fov < math.pi:
        raise ValueError(f"the browser sent an invalid camera: {pose}")
    world_to_camera = Rotation.from_quat([x, y, z, w]).as_matrix().T
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * pose.fov)
    K = intrinsic_matrix((focal, focal), (width / 2, height / 2))
    return Camera.posed(world_to_camera, np.array(pose.position), K, size, time)


def pose_of(camera: Camera) -> Pose:
    """The pose of a camera as a pinhole; its principal point is lost, because a browser has none."""
    camera = camera.to("cpu").pinhole
    x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3].double().numpy().T).as_quat().tolist()
    fov = 2.0 * math.atan2(0.5 * camera.height, float(camera.K[1, 1]))
    return Pose((w, x, y, z), tuple(camera.position.tolist()), fov)
