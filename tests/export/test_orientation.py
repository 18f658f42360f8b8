"""Exported scenes stand upright and look the same from cameras that are rotated with them."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.export import scenes
from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.formats.rotation import rotated
from warpgs.video import orientation

ROTATIONS = {
    "any": Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(),
    "z up": orientation.upright((0.0, 0.0, 1.0)),
    "y up": orientation.upright((0.0, 1.0, 0.0)),
    "glTF": orientation.upright((0.1, 0.3, -0.7), y_up=True),
}


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
@pytest.mark.parametrize("degree", [0, 3])
def test_rotated_cameras_see_the_same_image_of_a_rotated_cloud(rotation, degree):
    cloud, camera = scenes.cloud(60, degree), scenes.camera()
    viewmat = camera.viewmat.clone()
    viewmat[:3, :3] = viewmat[:3, :3] @ torch.from_numpy(rotation.T).float()
    image = scenes.image(rotated(cloud, rotation), dataclasses.replace(camera, viewmat=viewmat))
    assert (image - scenes.image(cloud, camera)).abs().max() < 1e-5


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.2, -0.5, 3.0)])
@pytest.mark.parametrize("y_up", [False, True])
def test_up_is_turned_to_the_readers_axis_by_a_rotation(up, y_up):
    rotation = orientation.upright(up, y_up)
    assert rotation @ up / np.linalg.norm(up) == pytest.approx([0, 1 if y_up else -1, 0], abs=1e-9)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_a_scene_that_stands_upright_is_not_changed():
    assert (orientation.upright((0.0, -1.0, 0.0)) == np.eye(3)).all()


@pytest.mark.parametrize(("arc", "down"), [(150.0, 40.0), (15.0, 0.0)])
def test_the_vertical_is_found_from_cameras_without_roll(arc, down):
    """Cameras on an arc [degrees] around a point, all looking down by the same angle, which tilts their own up."""
    up = torch.nn.functional.normalize(torch.tensor([0.3, 0.2, 0.9]), dim=0)
    first = torch.nn.functional.normalize(torch.linalg.cross(up, torch.tensor([1.0, 0.0, 0.0])), dim=0)
    second, cameras = torch.linalg.cross(up, first), {}
    for k, turn in enumerate(torch.linspace(0, np.radians(arc), 9)):
        position = first * turn.cos() + second * turn.sin() + np.tan(np.radians(down)) * up
        cameras[str(k)] = Camera.looking_at(position, torch.zeros(3), up, 50.0, (20, 10))
    capture = Capture("arc", cameras, list(cameras), [], torch.zeros(0, 3), None, lambda name: pytest.fail("read"), 0)
    assert orientation.vertical(capture) == pytest.approx(up.numpy(), abs=1e-3)
