"""A capture reads frames on request and caches the last ones."""

import dataclasses

import pytest
import torch

from warpgs.cameras import Camera
from warpgs.data import capture as capture_module
from warpgs.data.capture import MIN_EXTENT, Capture, Frame, missing_view


def camera(x: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, torch.eye(3), 4, 2)


def make_capture(xs=(0.0, 2.0, 4.0), cache_frames=256, train=None, mask=None, depth=None):
    """A capture with cameras along x, and the list of the frames read so far."""
    cameras, read = {f"f{k}": camera(x) for k, x in enumerate(xs)}, []

    def frame(name: str) -> Frame:
        read.append(name)
        return Frame(name, cameras[name], torch.zeros(2, 4, 3, dtype=torch.uint8), mask, depth)

    train = tuple(cameras) if train is None else train
    return Capture("c", cameras, train, (), torch.zeros(0, 3), None, frame, cache_frames), read


def test_opening_a_capture_reads_no_frame():
    assert make_capture()[1] == []


def test_a_capture_is_shown_in_one_line():
    assert repr(make_capture()[0]) == "<Capture c: 3 frames to train on, 0 to evaluate on, 0 points>"


def test_a_frame_is_read_once():
    capture, read = make_capture()
    assert capture.frame("f1") is capture.frame("f1")
    assert read == ["f1"]


def test_only_the_last_frames_are_cached():
    capture, read = make_capture(cache_frames=2)
    for name in ("f0", "f1", "f2", "f2", "f1", "f0"):
        capture.frame(name)
    assert read == ["f0", "f1", "f2", "f0"]


def test_frames_come_in_the_order_of_their_names():
    capture, read = make_capture()
    assert [frame.name for frame in capture.frames(("f2", "f0", "f1"))] == ["f2", "f0", "f1"]
    assert sorted(read) == ["f0", "f1", "f2"]


def test_the_cache_of_frames_has_a_maximum_size(monkeypatch):
    frame_bytes = capture_module.FRAME_BYTES_PER_PIXEL * make_capture()[0].cameras["f0"].width * 2
    monkeypatch.setattr(capture_module, "MAX_CACHE_BYTES", 2 * frame_bytes)
    capture, read = make_capture()
    for name in ("f0", "f1", "f2", "f2", "f1", "f0"):
        capture.frame(name)
    assert read == ["f0", "f1", "f2", "f0"]


def test_an_unknown_frame_is_a_key_error():
    with pytest.raises(KeyError, match="nine"):
        make_capture()[0].frame("nine")


def test_a_view_that_is_not_there_is_told_the_similar_one_or_the_first():
    capture = make_capture()[0].split(["f1", "f2"], [])
    assert missing_view(capture, "F2") == "c has no view 'F2'; did you mean 'f2'?"
    assert missing_view(capture, 7) == "c has no view 7; its first is 'f1'"
    assert missing_view(capture.split(["f1"], ["f2"]), "middle") == "c has no view 'middle'; its first is 'f2'"


def test_a_number_or_a_long_name_that_is_no_view_is_shown_as_given():
    capture = make_capture()[0]
    capture = dataclasses.replace(capture, cameras={"10": capture.cameras["f1"]}, train=["10"], val=[])
    assert missing_view(capture, 10) == "c has no view 10; did you mean '10'?"
    name = "shots/left_camera_of_the_pair/000001.png"
    assert repr(name) in missing_view(capture, name)


def test_the_extent_is_a_tenth_more_than_the_radius_of_the_training_cameras():
    assert make_capture()[0].extent == pytest.approx(1.1 * 2.0)
    assert make_capture(train=("f0", "f1"))[0].extent == pytest.approx(1.1 * 1.0)


def test_a_camera_that_does_not_move_has_the_minimum_extent():
    assert make_capture(xs=(3.0,))[0].extent == MIN_EXTENT


def test_a_capture_without_training_frames_is_refused():
    with pytest.raises(ValueError, match="c has no frames to train on"):
        make_capture(train=())


SOME_STATIC = torch.tensor([[True, False, True, True], [True, True, False, True]])


@pytest.mark.parametrize("mask", [None, SOME_STATIC])
@pytest.mark.parametrize(("assumption", "is_static"), [("static", True), ("dynamic", False)])
def test_an_assumption_replaces_the_masks(mask, assumption, is_static):
    capture = make_capture(mask=mask)[0].assuming(assumption)
    assert capture.assumption == assumption
    assert torch.equal(capture.frame("f0").static_mask, torch.full((2, 4), is_static))


@pytest.mark.parametrize("mask", [None, SOME_STATIC])
def test_assuming_masks_leaves_frames_as_they_are(mask):
    capture, _ = make_capture(mask=mask)
    assert capture.assuming("masks").frame("f0") is capture.frame("f0")
    assert capture.frame("f0").static_mask is mask


def test_an_assumption_leaves_the_capture_itself_unchanged():
    capture, _ = make_capture(mask=SOME_STATIC)
    assumed = capture.assuming("static")
    assumed.frame("f0")
    assert capture.assumption == "masks"
    assert capture.frame("f0").static_mask is SOME_STATIC
    assert assumed.assuming("masks").frame("f0").static_mask is SOME_STATIC


def test_an_assumption_shares_the_cache_and_everything_but_the_mask():
    capture, read = make_capture(mask=SOME_STATIC)
    assumed = capture.assuming("dynamic")
    assert assumed.frame("f1").image is capture.frame("f1").image
    assert read == ["f1"]
    assert (assumed.train, assumed.extent, assumed.points) == (capture.train, capture.extent, capture.points)
