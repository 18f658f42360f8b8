"""The pose that the view has while it follows the training camera."""

import math

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.video.test_camera_paths import camera, capture_of
from warpgs.video import camera_paths
from warpgs.viewer.pose import pose_of
from warpgs.viewer.training_path import FRAMES, TrainingPath

MOVING = capture_of([camera(0.1 * k, k / 4) for k in range(5)])
OWN = camera().width / camera().height


@pytest.mark.parametrize("frame", [0, 1, 100, FRAMES - 1])
def test_the_view_is_on_the_smoothed_path_of_the_training_camera(frame):
    expected = pose_of(camera_paths.training_path(MOVING, FRAMES)[frame])
    found = TrainingPath(MOVING).pose(frame / (FRAMES - 1), OWN)
    for actual, wanted in zip(found, expected, strict=True):
        assert actual == pytest.approx(wanted, abs=1e-5)


def test_between_two_cameras_of_the_path_the_view_moves_on():
    path, step = TrainingPath(MOVING), 1.0 / (FRAMES - 1)
    before, between, after = (path.pose(0.5 + part * step, OWN).position[0] for part in (0.0, 0.25, 1.0))
    assert between - before == pytest.approx(0.25 * (after - before), rel=0.05)
    assert after > before


@pytest.mark.parametrize(("aspect", "factor"), [(2.0 * OWN, 1.0), (OWN, 1.0), (0.5 * OWN, 2.0)])
def test_the_whole_image_of_the_training_camera_is_in_view(aspect, factor):
    path = TrainingPath(MOVING)
    half = math.tan(0.5 * path.pose(0.5, OWN).fov)
    assert math.tan(0.5 * path.pose(0.5, aspect).fov) == pytest.approx(factor * half)


def test_a_single_camera_stays_where_it_is():
    path = TrainingPath.of(capture_of([camera()]))
    assert path.pose(0.0, OWN) == path.pose(1.0, OWN) == pose_of(camera())


def test_cameras_that_jump_from_frame_to_frame_have_no_path(monkeypatch):
    monkeypatch.setattr(camera_paths, "jumps", lambda _: True)
    assert TrainingPath.of(MOVING) is None
