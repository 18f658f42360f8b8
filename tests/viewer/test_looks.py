"""Where the viewer's camera is put."""

import math

import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.video.test_camera_paths import capture
from warpgs.viewer.looks import look_through
from warpgs.viewer.training_cameras import TrainingCameras

TRAINING = TrainingCameras(capture([0.0, 0.4], [0.0, 1.0]))
VIEW = TRAINING.views[1]


@pytest.mark.parametrize("wider", [1.0, 1.5, 100.0])
def test_a_canvas_that_is_wide_enough_has_the_cameras_own_field_of_view(wider):
    assert look_through(TRAINING, 1, wider * VIEW.aspect).fov == pytest.approx(VIEW.pose.fov)


@pytest.mark.parametrize("narrower", [0.9, 0.5, 0.1])
def test_a_narrow_canvas_has_the_whole_width_of_the_picture(narrower):
    look = look_through(TRAINING, 1, narrower * VIEW.aspect)
    across = narrower * VIEW.aspect * math.tan(look.fov / 2)
    assert across == pytest.approx(VIEW.aspect * math.tan(VIEW.pose.fov / 2))


def test_the_camera_stands_where_the_training_camera_does_and_looks_ahead():
    look = look_through(TRAINING, 1)
    assert look.position == pytest.approx(np.array(VIEW.pose.position))
    assert look.target == pytest.approx(TRAINING.ahead(1))
