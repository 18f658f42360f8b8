"""What was filmed: near a training camera, and towards what it saw."""

import math

import numpy as np
import pytest
import torch

from tests.video.test_camera_paths import UP, camera, capture_of
from warpgs.cameras import Camera
from warpgs.video.camera_paths import BULLET_ARC
from warpgs.video.filmed import DRAG_LIMIT, MAX_CAMERAS, REACH, Filmed, position_and_axis

DEPTH = 2.0
"""All cameras of ``camera`` look at the origin from z = -2."""

POINTS = torch.zeros(1, 3)


def outside(filmed, position, forward=(0.0, 0.0, 1.0)):
    forward = np.array(forward)
    return filmed.outside(np.array(position), forward / np.linalg.norm(forward))


@pytest.fixture
def filmed():
    """By one camera."""
    return Filmed.by(capture_of([camera()]), POINTS)


def test_a_training_camera_is_within_what_was_filmed(filmed):
    assert filmed.outside(*position_and_axis(camera())) == pytest.approx(0.0, abs=1e-3)  # axes are in float32


def test_the_depth_is_of_the_points_of_the_scene_where_the_capture_has_none(filmed):
    assert filmed.depths.tolist() == pytest.approx([DEPTH])


def test_the_border_lies_at_the_angle_that_bullet_time_swings_by(filmed):
    reach = DEPTH * math.tan(BULLET_ARC)
    assert outside(filmed, (reach, 0.0, -DEPTH), (-reach, 0.0, DEPTH)) == pytest.approx(1.0)
    assert outside(filmed, (0.0, 2 * reach, -DEPTH), (0.0, -2 * reach, DEPTH)) == pytest.approx(2.0)


def test_along_the_view_there_is_twice_as_much_room(filmed):
    reach = DEPTH * REACH
    assert outside(filmed, (0.0, 0.0, 2 * reach - DEPTH)) == pytest.approx(1.0)
    assert outside(filmed, (0.0, 0.0, -2 * reach - DEPTH)) == pytest.approx(1.0)


def test_a_view_that_turns_away_is_outside_where_its_middle_leaves_the_image(filmed):
    half = math.atan(24 / 50)  # of an image 48 pixels high with a focal length of 50
    assert outside(filmed, (0.0, 0.0, -DEPTH), (math.sin(half), 0.0, math.cos(half))) == pytest.approx(1.0)
    assert outside(filmed, (0.0, 0.0, -DEPTH), (0.0, 0.0, -1.0)) > DRAG_LIMIT


def test_the_nearest_training_camera_decides():
    filmed = Filmed.by(capture_of([camera(x, x) for x in (-1.0, 0.0, 1.0)]), POINTS)
    for x in (-1.0, 0.0, 1.0):
        assert filmed.outside(*position_and_axis(camera(x))) == pytest.approx(0.0, abs=1e-3)  # axes are in float32
    assert outside(filmed, (3.0, 0.0, -DEPTH)) > DRAG_LIMIT


def test_cameras_near_others_and_more_than_the_maximum_are_left_out():
    still = Filmed.by(capture_of([camera(1e-3 * k, float(k)) for k in range(50)]), POINTS)
    assert len(still.depths) == 1
    points = torch.tensor([[0.2 * k, 0.0, 0.0] for k in range(3 * MAX_CAMERAS)])
    row = [Camera.looking_at(p - torch.tensor([0.0, 0.0, DEPTH]), p, UP, 50.0, (64, 48), float(p[0])) for p in points]
    apart = Filmed.by(capture_of(row), points)
    assert len(apart.depths) == MAX_CAMERAS
    assert max(apart.outside(*position_and_axis(camera)) for camera in row) < 1  # along a walk of 120 times the depth


def test_the_scale_of_a_scene_does_not_matter():
    near, far = (Filmed(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([d]), np.array([0.5])) for d in (1.0, 50.0))
    assert outside(near, (0.1, 0.2, 0.3)) == pytest.approx(outside(far, (5.0, 10.0, 15.0)))
