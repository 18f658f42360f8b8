"""Conversion between cameras and browser poses."""

import math

import pytest
import torch

from warpgs.cameras import Camera
from warpgs.viewer.pose import Pose, camera_of, pose_of

SIZE = (64, 48)


def camera_at(position, target, focal=50.0):
    up = torch.tensor([0.1, -1.0, 0.2])
    return Camera.looking_at(torch.tensor(position), torch.tensor(target), up, focal, SIZE, 0.25)


@pytest.mark.parametrize("position", [[0.0, 0.0, -2.0], [1.5, -0.3, 0.7], [-3.0, 2.0, 5.0]])
def test_a_camera_survives_the_conversion_to_a_pose_and_back(position):
    camera = camera_at(position, [0.1, 0.2, 0.3])
    back = camera_of(pose_of(camera), SIZE, camera.time)
    torch.testing.assert_close(back.viewmat, camera.viewmat, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.K, camera.K, atol=1e-4, rtol=0)
    assert (back.size, back.time) == (camera.size, camera.time)


def test_without_a_rotation_the_camera_looks_along_z():
    camera = camera_of(Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 1.0), SIZE, 0.0)
    row, column, depth, inside = camera.project(torch.tensor([[0.01, 0.01, 0.0]]))
    assert (row.item(), column.item(), inside.item()) == (24, 32, True)
    assert depth.item() == pytest.approx(3.0)


def test_the_field_of_view_is_vertical():
    camera = camera_of(Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.pi / 2), SIZE, 0.0)
    assert camera.K[1, 1].item() == pytest.approx(24.0)


@pytest.mark.parametrize(
    "pose",
    [
        Pose((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0),
        Pose((1.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0), 1.0),
        Pose((1.0, 0.0, math.inf, 0.0), (0.0, 0.0, 0.0), 1.0),
        Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0),
        Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 3.2),
    ],
)
def test_an_invalid_pose_is_refused(pose):
    with pytest.raises(ValueError, match="the browser sent an invalid camera"):
        camera_of(pose, SIZE, 0.0)
