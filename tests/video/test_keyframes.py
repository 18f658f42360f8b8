"""Paths follow the keyframes of a JSON file; an invalid file is refused with a one-line message."""

import json

import numpy as np
import pytest
import torch

from tests.export.scenes import refusal
from tests.video.test_camera_paths import capture, is_rigid, positions
from warpgs.video.keyframes import read_path

CAPTURE = capture([0.0, 0.4], [0.0, 1.0])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "path.json"


def read(path, keyframes, frames=5, **others):
    path.write_text(json.dumps({"keyframes": keyframes, **others}))
    return read_path(path, CAPTURE, frames)


AIMED = {"position": [0.1, 0.2, -1.0], "target": [0.0, 0.0, 0.5], "time": 0.5}


def test_a_path_passes_through_the_views_of_its_keyframes(path):
    cameras = read(path, [{"view": "1", "time": 0.0}, {"view": "0", "time": 1.0}])
    assert (cameras[0].viewmat - CAPTURE.cameras["1"].viewmat).abs().max() < 1e-5
    assert (cameras[-1].viewmat - CAPTURE.cameras["0"].viewmat).abs().max() < 1e-5
    assert [c.time for c in cameras] == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert is_rigid(cameras)


def test_a_position_looks_at_its_target_and_is_upright(path):
    camera = read(path, [AIMED])[0]
    assert (camera.position - torch.tensor(AIMED["position"])).abs().max() < 1e-5
    target = camera.viewmat[:3, :3] @ torch.tensor(AIMED["target"]) + camera.viewmat[:3, 3]
    assert target[:2].abs().max() < 1e-5
    assert target[2] > 0
    assert camera.viewmat[1, 1] > 0.9


def test_the_upward_direction_can_be_given(path):
    assert read(path, [AIMED], up=[1, 0, 0])[0].viewmat[1, 0] < -0.9


def test_a_focal_length_can_be_given(path):
    K = read(path, [{**AIMED, "focal": 75}])[0].K
    assert [float(K[0, 0]), float(K[1, 1])] == pytest.approx([75.0, 75.0])


def test_keyframes_can_be_unevenly_spaced(path):
    keyframes = [{**AIMED, "time": time, "at": at} for time, at in ((0.0, 0), (1.0, 1), (0.2, 4))]
    assert [c.time for c in read(path, keyframes)] == pytest.approx([0.0, 1.0, 0.2 + 0.8 * 2 / 3, 0.2 + 0.8 / 3, 0.2])


def test_keyframes_of_the_viewer_are_read_unchanged(path):
    cameras = [CAPTURE.cameras["0"], CAPTURE.cameras["1"]]
    sizes = {"width": 64, "height": 48}
    keyframes = [{"time": c.time, "viewmat": c.viewmat.tolist(), "K": c.K.tolist(), **sizes} for c in cameras]
    read_back = read(path, keyframes, frames=2)
    for a, b in zip(read_back, cameras, strict=True):
        assert (a.viewmat - b.viewmat).abs().max() < 1e-5
        assert (a.K - b.K).abs().max() < 1e-4
        assert (a.size, a.time) == (b.size, b.time)


SAVED = {"viewmat": torch.eye(4).tolist(), "time": 0.0}


def test_keyframes_of_other_sizes_keep_their_field_of_view_at_the_first_size(path):
    large = {"K": [[100, 0, 80], [0, 100, 60], [0, 0, 1]], "width": 160, "height": 120}
    wide = {"K": [[50, 0, 70], [0, 50, 20], [0, 0, 1]], "width": 120, "height": 60}
    cameras = read(path, [{**SAVED, **large}, {**SAVED, **wide}], frames=2)
    assert [c.size for c in cameras] == [(160, 120)] * 2
    assert (cameras[1].K - torch.tensor([[100.0, 0, 100], [0, 100, 40], [0, 0, 1]])).abs().max() < 1e-3


def test_a_single_keyframe_gives_a_constant_path(path):
    assert len({tuple(p.tolist()) for p in positions(read(path, [AIMED], frames=4))}) == 1


@pytest.mark.parametrize(
    ("keyframe", "words"),
    [
        (3, "keyframe 1 must be a JSON object, got int"),
        ({}, "must have either a view, or a position and a target, or a viewmat"),
        ({"view": "0", "position": [0, 0, 0], "target": [0, 0, 1], "time": 0}, "must have either a view"),
        ({"position": [0, 0, 0], "time": 0}, "must have either a view"),
        ({"view": "9", "time": 0}, "test has no view '9'; its first is '0'$"),
        ({"view": "00", "time": 0}, r"test has no view '00'; did you mean '0'\?$"),
        ({"view": ["0"], "time": 0}, r"test has no view \['0'\]"),
        ({"view": "0"}, "time must be a number, got None"),
        ({"view": "0", "time": "0"}, "time must be a number, got '0'"),
        ({"view": "0", "time": True}, "time must be a number, got True"),
        ({"view": "0", "time": 1.5}, r"time must be in \[0, 1\], got 1.5"),
        ({"view": "0", "time": float("nan")}, "time must be a number, got nan"),
        ({"view": "0", "time": 0, "speed": 2}, "unknown field 'speed'"),
        ({"view": "0", "time": 0, "focal": -1}, "focal must have a focal length of at least 0.001 px"),
        ({"view": "0", "time": 0, "focal": 1e-300}, "focal must have a focal length of at least"),
        ({**SAVED, "K": [[1e-300, 0, 1], [0, 1, 1], [0, 0, 1]], "width": 9, "height": 9}, "K must have a focal length"),
        ({**SAVED, "K": [[1, 0, 1], [0, -1, 1], [0, 0, 1]], "width": 9, "height": 9}, "K must have a focal length"),
        ({**AIMED, "target": AIMED["position"]}, "position and target coincide"),
        ({**AIMED, "target": [0.1, 9.0, -1.0]}, "the view direction is parallel to up"),
        ({**AIMED, "position": [0, 0]}, "position must be three numbers"),
        ({**AIMED, "position": [0, 0, 1e300]}, "position must be a number"),
        ({**SAVED, "viewmat": [[1, 0], [0, 1]]}, "viewmat must be 4 rows of 4 numbers"),
        ({**SAVED, "viewmat": (2 * torch.eye(4)).tolist()}, "viewmat must be a rotation and a translation"),
        ({**SAVED, "viewmat": torch.diag(torch.tensor([1.0, 1, -1, 1])).tolist()}, "viewmat must be a rotation"),
        ({**SAVED, "K": torch.eye(3).tolist()}, "must have all of K, width and height"),
        ({**SAVED, "K": torch.eye(3).tolist(), "width": 10, "height": 0}, "expected a width and a height"),
        ({**SAVED, "K": torch.ones(3, 3).tolist(), "width": 10, "height": 9}, "K must be"),
    ],
)
def test_an_invalid_keyframe_is_refused_with_its_number(path, keyframe, words):
    with pytest.raises(ValueError, match=words) as error:
        read(path, [{"view": "0", "time": 0.0}, keyframe])
    assert str(error.value).startswith(f"{path}: keyframe 1")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not valid JSON"),
        ("{", "is not valid JSON"),
        ('{"keyframes": [{"view": "0", "time": ' + 5000 * "1" + "}]}", "is not valid JSON"),
        ("[" * 100_000, "is not valid JSON"),
        ("[]", "must hold a JSON object, got list"),
        ("{}", "has no list of keyframes"),
        ('{"keyframes": []}', "has no list of keyframes"),
        ('{"keyframes": {}}', "has no list of keyframes"),
        ('{"keyframes": [], "fps": 3}', "unknown field 'fps'"),
        ('{"keyframes": [{"view": "0", "time": 0}], "up": 1}', "up must be three numbers"),
        ('{"keyframes": [{"view": "0", "time": 0, "at": 1}, {"view": "0", "time": 0}]}', "every keyframe has a field"),
        ('{"keyframes": [{"view": "0", "time": 0, "at": 1}, {"view": "0", "time": 0, "at": 1}]}', "at must increase"),
        ('{"keyframes": [{"view": "0", "time": 0, "at": 1' + 400 * "0" + "}]}", "at has more than 64 bits"),
        ('{"keyframes": [{"view": "0", "time": 1' + 400 * "0" + "}]}", "time has more than 64 bits"),
    ],
)
def test_an_invalid_path_is_refused_with_a_one_line_message(path, text, words):
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        read_path(path, CAPTURE, 3)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


UNREADABLE = {
    "missing": (lambda path: None, r"path\.json is missing"),
    "folder": (lambda path: path.mkdir(), "is not a file"),
    "binary": (lambda path: path.write_bytes(b"\xff\xfe"), "is not valid JSON"),
    "huge": (lambda path: path.write_text(" " * ((1 << 20) + 1)), "has 1,048,577 bytes, more than"),
    "device, whose size is 0": (lambda path: path.symlink_to("/dev/zero"), "is not a file"),
}


@pytest.mark.parametrize(("make", "message"), UNREADABLE.values(), ids=UNREADABLE)
def test_what_is_not_a_file_of_a_path_is_refused(path, make, message):
    make(path)
    with pytest.raises(ValueError, match=message):
        read_path(path, CAPTURE, 3)


def test_a_damaged_file_is_either_read_or_refused_with_a_one_line_message(path):
    saved = {**SAVED, "K": CAPTURE.cameras["0"].K.tolist(), "width": 32, "height": 24}
    text = json.dumps({"up": [0, -1, 0], "keyframes": [{"view": "0", "time": 0.0}, AIMED, saved]}).encode()
    path.write_bytes(text)
    assert len(read_path(path, CAPTURE, 3)) == 3
    random = np.random.default_rng(0)
    for _ in range(600):
        data = bytearray(text)
        for index in random.integers(0, len(data), random.integers(1, 4)):
            data[index] = random.choice([random.integers(256), *b'0123456789eE"[]{},:-.'])
        path.write_bytes(data[: random.integers(len(data))] if random.random() < 0.2 else data)
        message = refusal(lambda path: read_path(path, CAPTURE, 3), path)
        assert message is None or (str(path) in message and "\n" not in message)
        for camera in [] if message is not None else read_path(path, CAPTURE, 3):
            assert bool(camera.viewmat.isfinite().all())
            assert bool(camera.K.isfinite().all())
            assert min(float(camera.K[0, 0]), float(camera.K[1, 1])) > 0
