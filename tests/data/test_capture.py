"""A capture reads frames when they are asked for, and keeps some."""

import pytest
import torch

from warpgs.cameras import Camera
from warpgs.data.capture import MIN_EXTENT, Capture, Frame


def camera(x: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, torch.eye(3), 4, 2)


def capture(xs=(0.0, 2.0, 4.0), cache_frames=256, train=None):
    """A capture with cameras along x, and the list of the frames read so far."""
    cameras, read = {f"f{k}": camera(x) for k, x in enumerate(xs)}, []

    def frame(name: str) -> Frame:
        read.append(name)
        return Frame(name, cameras[name], torch.zeros(2, 4, 3, dtype=torch.uint8))

    train = tuple(cameras) if train is None else train
    return Capture("c", cameras, train, (), torch.zeros(0, 3), None, frame, cache_frames), read


def test_nothing_is_read_before_it_is_asked_for():
    assert capture()[1] == []


def test_a_frame_is_read_once():
    scene, read = capture()
    assert scene.frame("f1") is scene.frame("f1")
    assert read == ["f1"]


def test_only_the_last_frames_are_kept():
    scene, read = capture(cache_frames=2)
    for name in ("f0", "f1", "f2", "f2", "f1", "f0"):
        scene.frame(name)
    assert read == ["f0", "f1", "f2", "f0"]


def test_an_unknown_frame_is_a_key_error():
    with pytest.raises(KeyError, match="nine"):
        capture()[0].frame("nine")


def test_the_extent_is_a_tenth_more_than_the_radius_of_the_training_cameras():
    assert capture()[0].extent == pytest.approx(1.1 * 2.0)
    assert capture(train=("f0", "f1"))[0].extent == pytest.approx(1.1 * 1.0)


def test_a_camera_that_stands_still_has_the_smallest_extent():
    assert capture(xs=(3.0,))[0].extent == MIN_EXTENT


def test_a_capture_without_training_frames_is_refused():
    with pytest.raises(ValueError, match="c has no frames to train on"):
        capture(train=())
