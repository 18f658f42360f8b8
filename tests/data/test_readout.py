"""Captures filmed with a rolling shutter: the motion of their cameras."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.data.captures import edit_json, refused, write_capture
from tests.test_shutter import at_readout
from warpgs.cameras import Camera
from warpgs.captures.import_capture import import_capture
from warpgs.captures.opening import load_capture, open_capture
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture, Frame
from warpgs.data.readout import with_readout

SIZE = (40, 24)
K = np.array([[30.0, 0.0, 20.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])
TRAIN, VAL = {"a": 0.0, "b": 0.25, "d": 0.75, "e": 1.0}, {"c": 0.5}


def on_path(time: float, turn: float = 0.2, shift: float = 0.0) -> Camera:
    """A camera that turns by an angle [radians] and moves from time 0 to 1, at a constant speed."""
    axis, move = np.array([0.48, 0.8, -0.36]), np.array([0.4, -0.3, 0.8])
    rotation = Rotation.from_rotvec([0.1, -0.4, 0.2]) * Rotation.from_rotvec(-time * turn * axis)
    return Camera.posed(rotation.as_matrix(), np.array([0.2 + shift, 0.1, -3.0]) + time * move, K, SIZE, time)


def filmed(train: dict[str, float], val: dict[str, float], **path: float) -> Capture:
    """Frames at times; the keyword arguments are of the path."""
    cameras = {name: on_path(time, **path) for name, time in {**train, **val}.items()}
    frames = {name: Frame(name, c, torch.zeros(*SIZE[::-1], 3, dtype=torch.uint8)) for name, c in cameras.items()}
    return Capture("walk", cameras, [*train], [*val], torch.zeros(0, 3), None, frames.__getitem__)


def assert_rows_see(capture: Capture, interval: float, **path: float) -> None:
    """Compares the pose of first and last rows with the path."""
    for camera in capture.cameras.values():
        for s in (-0.5, 0.5):
            expected = on_path(camera.time + s * capture.readout * interval, **path)
            torch.testing.assert_close(at_readout(camera, s).viewmat, expected.viewmat, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("readout", [1.0, 0.4, -0.4])
def test_the_first_and_the_last_row_are_where_the_camera_is_on_its_path(readout):
    assert_rows_see(with_readout(filmed(TRAIN, VAL), readout), interval=0.25)


def test_the_speed_at_the_ends_of_a_curved_path_is_that_of_the_path():
    names = [f"{k:02d}" for k in range(21)]
    capture = filmed({name: k / 20 for k, name in enumerate(names)}, {})
    swaying = {}
    for k, name in enumerate(names):
        viewmat = capture.cameras[name].viewmat.clone()
        viewmat[:3, :3], viewmat[:3, 3] = torch.eye(3), torch.tensor([-math.sin(0.25 * k), 0.0, 0.0])
        swaying[name] = dataclasses.replace(capture.cameras[name], viewmat=viewmat)
    moving = with_readout(capture.with_cameras(swaying), 0.5)
    for k, name in enumerate(names):
        speed = 0.5 * 0.25 * math.cos(0.25 * k)
        assert moving.cameras[name].motion[1, 0].item() == pytest.approx(speed, abs=0.02 * 0.5 * 0.25)


def test_the_speed_of_a_frame_is_of_its_own_camera():
    """Two cameras with an offset in time, of which one stands."""
    moving = filmed({"a": 0.0, "b": 0.25, "c": 0.5, "d": 0.75}, {})
    still = {f"still {k}": dataclasses.replace(on_path(0.0, shift=2.0), time=0.1 + 0.25 * k, id=1) for k in range(4)}
    both = dataclasses.replace(moving, cameras={**moving.cameras, **still}, train=[*moving.train, *still])
    found = with_readout(both, 0.5).cameras
    for name in moving.train:
        assert torch.equal(found[name].motion, with_readout(moving, 0.5).cameras[name].motion)
    for name in still:
        torch.testing.assert_close(found[name].motion, torch.zeros(2, 3), rtol=0.0, atol=1e-6)


def test_frames_are_read_with_their_motion():
    capture = with_readout(filmed(TRAIN, VAL), 0.5)
    assert capture.readout == 0.5
    assert capture.frame("a").camera.motion is capture.cameras["a"].motion


@pytest.mark.parametrize("readout", [1.0, -0.4, 0.0])
def test_the_duration_of_a_readout_is_a_part_of_the_time_between_training_frames(readout):
    cameras = with_readout(filmed({"a": 0.0, "b": 0.25, "c": 0.5, "d": 1.0}, {"e": 0.75}), readout).cameras
    assert [camera.duration for camera in cameras.values()] == pytest.approx([0.25 * readout] * len(cameras))


def test_cameras_with_a_global_shutter_have_no_motion():
    assert all(camera.motion is None for camera in with_readout(filmed(TRAIN, VAL), 0.0).cameras.values())


@pytest.mark.parametrize("readout", [1.01, -2.0, math.nan, math.inf])
def test_a_readout_longer_than_a_frame_is_refused(readout):
    with pytest.raises(ValueError, match=f"readout must be a number from -1 to 1, .*, got {readout}"):
        with_readout(filmed(TRAIN, VAL), readout)


@pytest.mark.parametrize(
    ("train", "val", "message"),
    [
        ({"a": 0.0, "b": 0.0}, {}, "one camera one after another: a and b have one time"),
        ({"a": 0.0, "b": 0.5}, {"c": 0.0}, "one camera one after another: a and c have one time"),
        ({"a": 0.0}, {}, "one camera one after another: a is the only one"),
    ],
)
def test_cameras_without_a_known_motion_are_refused(train, val, message):
    with pytest.raises(ValueError, match=message):
        with_readout(filmed(train, val), 1.0)


def test_the_readout_of_a_capture_is_in_its_files(tmp_path):
    root = write_capture(tmp_path / "capture", "nerfds")
    assert load_capture(root).readout == 0.0
    edit_json(root / "dataset.json", readout=0.6)
    capture = load_capture(root)
    assert capture.readout == 0.6
    assert all(camera.motion is not None for camera in capture.cameras.values())
    assert load_capture(root, readout=0.0).cameras[capture.train[0]].motion is None
    assert open_capture(TrainConfig(data=root, readout=0.3)).readout == 0.3


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("fast", "dataset.json: readout must hold numbers, got 'fast'"),
        ([0.5], r"dataset.json: readout must be finite numbers of shape \[\]"),
        (1.5, "capture: readout must be a number from -1 to 1"),
    ],
)
def test_a_file_with_a_wrong_readout_is_refused(value, message, tmp_path):
    root = write_capture(tmp_path / "capture", "nerfds")
    edit_json(root / "dataset.json", readout=value)
    refused(root, message)


def test_an_imported_capture_keeps_its_readout(tmp_path):
    root = write_capture(tmp_path / "capture", "nerfds")
    edit_json(root / "dataset.json", readout=0.6)
    import_capture(root, tmp_path / "copy")
    assert load_capture(tmp_path / "copy").readout == 0.6


@pytest.mark.parametrize(
    ("side", "sign", "by_columns"), [("top", 1, False), ("bottom", -1, False), ("left", 1, True), ("right", -1, True)]
)
def test_the_side_where_a_readout_begins_is_in_the_files_and_an_option(side, sign, by_columns, tmp_path):
    root = write_capture(tmp_path / "capture", "nerfds")
    asked = open_capture(TrainConfig(data=root, readout=0.6, readout_from=side))
    edit_json(root / "dataset.json", readout=0.6, readout_from=side)
    import_capture(root, tmp_path / "copy")
    downward = open_capture(TrainConfig(data=root, readout_from="top"))
    for capture in (asked, load_capture(root), load_capture(tmp_path / "copy")):
        assert (capture.readout, capture.readout_from) == (0.6, side)
        for name in capture.train:
            camera, plain = capture.cameras[name], downward.cameras[name]
            assert camera.by_columns is by_columns
            assert camera.duration == pytest.approx(sign * plain.duration)
            torch.testing.assert_close(camera.motion, sign * plain.motion, rtol=1e-3, atol=1e-5)


def test_a_side_that_there_is_not_is_refused(tmp_path):
    root = write_capture(tmp_path / "capture", "nerfds")
    edit_json(root / "dataset.json", readout_from="above")
    refused(root, "dataset.json: readout_from must be one of top, bottom, left, right, got 'above'")
