"""Truth beside render."""

import math

import numpy as np
import pytest

from warpgs.viewer.comparison import is_beside, wiped
from warpgs.viewer.pose import Pose, camera_of

SIZE = (80, 60)


def camera(angle=0.0, position=(0.0, 0.0, 0.0), size=SIZE, fov=1.0):
    """Turned around y by an angle [rad]."""
    return camera_of(Pose((math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0), position, fov), size, 0.0)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 1.0])
def test_the_left_part_shows_the_truth(fraction):
    rendered, truth = np.full((10, 40, 3), 10, np.uint8), np.full((10, 40, 3), 200, np.uint8)
    result = wiped(rendered, (truth, np.ones((10, 40), bool)), fraction)
    border = round(40 * fraction)
    assert (result[:, : max(0, border - 1)] == 200).all()
    assert (result[:, border + 1 :] == 10).all()


def test_without_truth_the_render_stays():
    rendered = np.full((10, 40, 3), 10, np.uint8)
    assert (wiped(rendered, (rendered + 50, np.zeros((10, 40), bool)), 0.5) == rendered).all()


def test_cameras_at_the_same_place_are_beside_each_other_in_any_direction():
    assert is_beside(camera(), camera(1.0), 1.0)
    assert not is_beside(camera(), camera(position=(0.01, 0.0, 0.0)), 1.0)
    assert is_beside(camera(), camera(position=(0.01, 0.0, 0.0)), 100.0)
