"""The check says whether the cameras of a capture agree."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.captures import edit_json
from tests.prepare import boards
from warpgs.captures.agreement_check import cameras_to_compare
from warpgs.captures.check import check_capture
from warpgs.captures.opening import load_capture
from warpgs.prepare.cameras.recovered import Cameras
from warpgs.prepare.scene import write_frames, write_scene

COUNT = 6


def place(x: float) -> np.ndarray:
    """[3, 4] the pose of a camera at a place to the right of the boards' middle, that looks at them."""
    turn = cv2.Rodrigues(np.array([0.0, 0.15 * x, 0.0]))[0]
    return np.hstack([turn, -turn @ np.array([[x], [0.0], [0.0]])])


def write_rig(root: Path, places: list[float]) -> Path:
    """A capture of still cameras."""
    rig, times = [], {}
    for k, x in enumerate(places):
        names = [f"{k}_{shot:06d}" for shot in range(COUNT)]
        images, masks = boards.record(COUNT, path=lambda time, x=x: place(x))
        for name, image in zip(names, images, strict=True):
            (root / "frames").mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / f"frames/{name}.png"), image[..., ::-1])
        rig.append(Cameras(names, boards.lens(), np.array([place(x)] * COUNT), boards.points(), 0.1, 9.0))
        write_frames(root, root / "frames", rig[-1], masks)
        times |= {name: 100 * shot + 10 * k for shot, name in enumerate(names)}
    write_scene(root, rig, boards.points(), times)
    return root


def agreement(root: Path) -> list[tuple[str, str]]:
    """Level and text of what the check says of the cameras together."""
    found = check_capture(root).findings
    return [(f.level, f.text) for f in found if f.text.startswith(("cameras", "what cameras"))]


@pytest.fixture
def root(tmp_path):
    return write_rig(tmp_path / "rig", [-0.8, 0.0, 0.9])


def test_cameras_of_a_rig_agree(root):
    ((level, text),) = agreement(root)
    assert level == "note"
    assert text.startswith("cameras 0 and 1, 1 and 2 agree: what they both see is 0.")


def test_a_camera_with_a_wrong_pose_is_named(root):
    turn = cv2.Rodrigues(np.array([0.06, 0.0, 0.02]))[0]
    for k in range(COUNT):
        edit_json(root / f"camera/2_{k:06d}.json", orientation=(turn @ place(0.9)[:, :3]).tolist())
    (warned, wrong), (noted, right) = agreement(root)
    assert warned == "warning"
    assert wrong.startswith("what cameras 1 and 2 both see is ")
    assert wrong.endswith("px off their epipolar lines (median): the pose or the lens of one of them is wrong")
    assert (noted, right[:20]) == ("note", "cameras 0 and 1 agre")


def test_cameras_without_a_common_view_cannot_be_compared(root):
    for k in range(COUNT):
        other = boards.texture(50 + k, (120, 120, 120), 256, (9, 31))[:192]
        cv2.imwrite(str(root / f"rgb/1x/0_{k:06d}.png"), other)
    assert ("note", "cameras 0 and 1 see too little alike at one time to be compared") in agreement(root)


def test_a_damaged_frame_to_evaluate_is_not_compared(root):
    index = json.loads((root / "dataset.json").read_text())
    val = [name for name in index["ids"] if name.startswith("2_")]
    edit_json(root / "dataset.json", train_ids=[n for n in index["ids"] if n not in val], val_ids=val)
    for name in val:
        (root / f"rgb/1x/{name}.png").write_bytes(b"damaged")
    report = check_capture(root)
    assert any(f.topic == "evaluation" and f.level == "error" for f in report.findings)
    assert ("note", "cameras 1 and 2 see too little alike at one time to be compared") in agreement(root)


def test_all_cameras_are_compared_with_the_one_next_to_them_at_nearly_one_time(tmp_path):
    capture = load_capture(write_rig(tmp_path / "rig", [0.9, -0.8, 0.0, 0.4]))
    compared = cameras_to_compare(capture, 12)
    assert [(c.first, c.second) for c in compared] == [(0, 3), (1, 2), (2, 3)]
    assert all(a[1:] == b[1:] and (int(a[0]), int(b[0])) == (c[0], c[1]) for c in compared for a, b in c.frames)
    assert len(cameras_to_compare(capture, 2)) == 2


def test_cameras_are_not_compared_while_one_of_them_does_not_film(tmp_path):
    """Camera 1 begins half of the time later: only frames from then on are compared, but for one interval."""
    capture = load_capture(write_rig(tmp_path / "rig", [-0.4, 0.4]))
    names = capture.by_camera(capture.train)
    later = {name: replace(capture.cameras[name], time=capture.cameras[name].time + 0.5) for name in names[1]}
    interval = capture.cameras[names[1][1]].time - capture.cameras[names[1][0]].time
    ((_, _, frames),) = cameras_to_compare(capture.with_cameras(later), 12)
    apart = [abs(capture.with_cameras(later).cameras[b].time - capture.cameras[a].time) for a, b in frames]
    assert len(apart) > 0
    assert max(apart) <= interval + 1e-6
    after = {name: replace(camera, time=camera.time + 9.0) for name, camera in later.items()}
    assert cameras_to_compare(capture.with_cameras(after), 12)[0].frames == []


def test_one_camera_is_not_compared(tmp_path):
    assert agreement(boards.write_capture(tmp_path / "one")) == []
