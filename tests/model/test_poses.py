"""Corrections of camera poses."""

import dataclasses
import math

import pytest
import torch

from tests.scenes import error, make_camera
from warpgs.model.poses import PoseCorrections, shared_places

VIEWMAT = make_camera().viewmat
INDEX = torch.tensor([1])


def poses(rotation=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0), unit=5.0):
    """Corrections of three cameras; only the second one is moved."""
    made = PoseCorrections(torch.arange(3), unit)
    with torch.no_grad():
        made.rotations[1], made.translations[1] = torch.tensor(rotation), torch.tensor(translation)
    return made


def test_cameras_stay_where_they_are_at_first():
    for index in range(3):
        assert torch.equal(PoseCorrections(torch.arange(3), 5.0)(VIEWMAT, torch.tensor([index])), VIEWMAT)


@pytest.mark.parametrize("axis", range(3))
def test_a_rotation_is_about_an_axis_of_the_camera(axis):
    angle = 0.3
    rotation = torch.zeros(3)
    rotation[axis] = 2.0 * math.tan(angle / 2.0)  # of the quaternion (1, r / 2)
    moved = poses(rotation.tolist())
    generators = torch.linalg.cross(torch.eye(3)[axis].expand(3, 3), torch.eye(3), dim=1).T
    expected = torch.eye(4)
    expected[:3, :3] = torch.matrix_exp(angle * generators)
    assert error(moved(VIEWMAT, INDEX), expected @ VIEWMAT) < 5e-6
    assert error(moved.angles(), torch.tensor([0.0, angle, 0.0])) < 1e-6


def test_a_large_correction_is_still_a_rigid_motion():
    moved = poses((3.0, -2.0, 1.0), (0.4, 0.5, -0.6))(VIEWMAT, INDEX)
    assert error(moved[:3, :3] @ moved[:3, :3].T, torch.eye(3)) < 1e-5
    assert torch.linalg.det(moved[:3, :3]) > 0.0
    assert torch.equal(moved[3], VIEWMAT[3])


def test_a_translation_is_in_units_along_the_axes_of_the_camera():
    moved = poses(translation=(0.1, 0.2, -0.2))
    assert error((moved(VIEWMAT, INDEX) - VIEWMAT)[:3, 3], torch.tensor([0.5, 1.0, -1.0])) < 1e-6
    assert error(moved.shifts(), torch.tensor([0.0, 0.3, 0.0])) < 1e-6


def test_only_the_chosen_camera_gets_a_gradient():
    corrections = poses()
    (corrections(VIEWMAT, INDEX) * torch.rand(4, 4)).sum().backward()
    for parameter in corrections.parameters():
        assert parameter.grad[1].abs().min() > 0.0
        assert not parameter.grad[[0, 2]].any()


def test_frames_of_a_camera_that_stands_still_share_a_correction():
    here, moved = make_camera(), dataclasses.replace(make_camera(), viewmat=VIEWMAT + 1e-6 * torch.eye(4))
    turning = dataclasses.replace(here, motion=torch.full((2, 3), 0.01))
    later = dataclasses.replace(here, time=0.9)
    places = shared_places([here, moved, later, turning, moved])
    assert places.tolist() == [0, 1, 0, 2, 1]
    corrections = PoseCorrections(places, 5.0)
    with torch.no_grad():
        corrections.translations[1] = 0.1
    shifted = [not torch.equal(corrections(VIEWMAT, torch.tensor([k])), VIEWMAT) for k in range(5)]
    assert shifted == [False, True, False, False, True]
