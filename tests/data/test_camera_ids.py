"""Frames of one time are of several cameras, which loaders tell apart."""

import json

import pytest

from tests.data import captures
from tests.data.captures import edit_json, write_json
from warpgs.captures.opening import load_capture

NAMES = [*captures.ids_of("nerfds")[0], *captures.ids_of("nerfds")[1]]


def capture_of(root, camera_ids=None, poses=None, times=None, split=False):
    """A capture of six frames with some camera_ids, times, and poses by their number."""
    captures.write_capture(root)
    metadata = json.loads((root / "metadata.json").read_text())
    for k, (name, entry) in enumerate(metadata.items()):
        del entry["camera_id"]
        if camera_ids is not None and camera_ids[k] is not None:
            entry["camera_id"] = camera_ids[k]
        entry["time_id"] = entry["time_id"] if times is None else times[k]
        if poses is not None:
            write_json(root / f"camera/{name}.json", captures.camera_fields(poses[k]))
    write_json(root / "metadata.json", metadata)
    if not split:
        edit_json(root / "dataset.json", train_ids=list(metadata), val_ids=[])
    return load_capture(root)


def ids(capture):
    return [capture.cameras[name].id for name in NAMES]


def test_camera_ids_of_the_files_are_kept(tmp_path):
    capture = capture_of(tmp_path, [0, 0, 0, 0, 7, 7])
    assert ids(capture) == [0, 0, 0, 0, 7, 7]
    assert {name: capture.frame(name).camera.id for name in NAMES} == dict(zip(NAMES, ids(capture), strict=True))


def test_without_camera_ids_all_frames_of_different_times_are_of_one_camera(tmp_path):
    assert ids(capture_of(tmp_path, times=range(6))) == [0] * 6


def test_poses_that_recur_are_still_cameras(tmp_path):
    capture = capture_of(tmp_path, poses=[1, 1, 2, 2, 3, 3], times=[0, 1, 0, 1, 0, 1])
    assert ids(capture) == [0, 0, 1, 1, 2, 2]
    assert any("3 still cameras are told apart by their poses" in note for note in capture.notes)
    assert capture.frame(NAMES[5]).camera.id == 2


def test_moving_cameras_of_training_and_evaluation_are_two(tmp_path):
    assert ids(capture_of(tmp_path, times=[0, 1, 2, 3, 0, 2], split=True)) == [0, 0, 0, 0, 1, 1]


def test_moving_cameras_that_nothing_tells_apart_have_no_neighbours_and_a_note(tmp_path):
    capture = capture_of(tmp_path, poses=range(6), times=[0, 1, 0, 1, 0, 1])
    assert ids(capture) == [0] * 6
    assert capture.neighbours(NAMES) == []
    assert any(f"such as {NAMES[0]} and {NAMES[2]} have one time" in note for note in capture.notes)


def test_a_static_capture_says_nothing_of_cameras(tmp_path):
    capture = capture_of(tmp_path, times=[3] * 6)
    assert ids(capture) == [0] * 6
    assert not any("camera" in note for note in capture.notes)


def test_two_moving_cameras_with_one_id_are_refused(tmp_path):
    with pytest.raises(ValueError, match=rf"{NAMES[0]} and {NAMES[2]} are of camera 0 at one time: give each camera"):
        capture_of(tmp_path, [0, 0, 0, 0, 1, 1], poses=range(6), times=[0, 1, 0, 1, 0, 1])


@pytest.mark.parametrize("wrong", [None, -1, 1.5, "left", True])
def test_a_camera_id_that_is_not_one_is_refused(tmp_path, wrong):
    with pytest.raises(ValueError, match=rf"metadata\.json: {NAMES[3]} has no camera_id from 0 on, which \d of 6"):
        capture_of(tmp_path, [0, 0, 0, wrong, 1, 1])
