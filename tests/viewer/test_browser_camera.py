"""Cameras of a browser."""

import math

import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.video.test_camera_paths import capture
from warpgs.viewer.browser_camera import through_training_camera
from warpgs.viewer.training_cameras import TrainingCameras

TRAINING = TrainingCameras(capture([0.0, 0.4], [0.0, 1.0]))
VIEW = TRAINING.views[1]


@pytest.mark.parametrize("wider", [1.0, 1.5, 100.0])
def test_a_wide_canvas_has_the_field_of_view_of_the_camera(wider):
    assert through_training_camera(TRAINING, 1, wider * VIEW.aspect).fov == pytest.approx(VIEW.pose.fov)


@pytest.mark.parametrize("narrower", [0.9, 0.5, 0.1])
def test_a_narrow_canvas_shows_the_whole_width_of_the_image(narrower):
    camera = through_training_camera(TRAINING, 1, narrower * VIEW.aspect)
    across = narrower * VIEW.aspect * math.tan(camera.fov / 2)
    assert across == pytest.approx(VIEW.aspect * math.tan(VIEW.pose.fov / 2))


def test_the_camera_is_at_the_training_camera_and_looks_straight_ahead():
    camera = through_training_camera(TRAINING, 1)
    assert camera.position == pytest.approx(np.array(VIEW.pose.position))
    assert camera.target == pytest.approx(TRAINING.target(1))
