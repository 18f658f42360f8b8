"""The built-in capture of small objects that move far: its layout, its motion, and that it is the same everywhere."""

import numpy as np
import pytest
import torch

from warpgs.captures.opening import load_capture
from warpgs.data.loaders import recognize
from warpgs.synthetic import balls
from warpgs.synthetic.balls import BallsSize, balls_capture

SMALL = BallsSize(side=24, num_frames=6, num_val=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return balls_capture(tmp_path_factory.mktemp("cache"), SMALL, quiet=True)


def test_it_has_the_layout_of_dnerf(folder):
    assert recognize(folder) == "blender"
    capture = load_capture(folder)
    assert (len(capture.train), len(capture.val), len(capture.points)) == (6, 4, 0)
    assert capture.assumption == "dynamic"
    assert capture.background == "white"


def test_images_are_white_where_they_are_empty_and_nowhere_else(folder):
    frame = load_capture(folder).frame("train_r_003")
    assert 0.8 < frame.empty.float().mean() < 0.99
    assert (frame.image[frame.empty] == 255).all()
    assert (frame.image[~frame.empty] < 255).any(1).all()
    assert torch.equal(frame.static_mask, frame.empty)


def test_every_second_evaluation_frame_lies_between_training_times(folder):
    capture = load_capture(folder)
    steps = [capture.cameras[name].time * (SMALL.num_frames - 1) for name in capture.val]
    assert [abs(step - round(step)) > 0.4 for step in steps] == [False, True] * 2


def test_balls_move_about_two_diameters_from_frame_to_frame():
    size = BallsSize()
    times = [k / (size.num_frames - 1) for k in range(size.num_frames)]
    centers = np.array([[body.center for body in balls._balls(time, size)] for time in times])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=2) / (2.0 * balls.RADIUS)
    assert 1.5 < steps.mean() < 2.5


def test_it_is_the_same_every_time(folder, tmp_path):
    again = balls_capture(tmp_path, SMALL, quiet=True)
    files = sorted(path.relative_to(folder) for path in folder.rglob("*.*"))
    assert len(files) == 12
    assert all((folder / path).read_bytes() == (again / path).read_bytes() for path in files)


def test_a_name_opens_the_capture(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(balls, "BallsSize", lambda: SMALL)
    assert len(load_capture("builtin:balls").train) == 6


def test_a_single_frame_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        balls_capture(tmp_path, BallsSize(num_frames=1), quiet=True)
