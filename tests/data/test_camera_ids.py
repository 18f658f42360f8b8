"""Frames of one time are of several cameras, which loaders tell apart."""

import json

import numpy as np
import pytest

from tests.data import captures, layouts
from tests.data.captures import edit_json, write_json
from warpgs.captures.opening import load_capture
from warpgs.data.loaders.name_times import times_of_names
from warpgs.export.camera_set import CameraSet
from warpgs.export.camera_writers import write_cameras

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


@pytest.mark.parametrize(
    "pattern", ["cam{:02d}/{:04d}.png", "images/cam{}_{:05d}.jpg", "{:.0f}_view/{:03d}.png", "gopro{:d}/GOPR{:04d}.jpg"]
)
def test_names_tell_cameras_and_times(pattern):
    names = [pattern.format(i, k) for i in (3, 7) for k in range(5)]
    found = times_of_names(names)
    assert found.cameras == [0] * 5 + [1] * 5
    assert found.times == [*map(float, range(5))] * 2


def test_names_of_one_camera_tell_one():
    assert times_of_names([f"frame_{k:03d}.png" for k in range(5)]).cameras == [0] * 5
    assert times_of_names([f"clip{k // 5}/{k % 5:03d}.png" for k in range(10)]).cameras == [0] * 10


def rename_frames(root, names):
    """Gives the images of a nerfstudio capture other names."""
    fields = json.loads((root / "transforms.json").read_text())
    frames = sorted(fields["frames"], key=lambda frame: frame["file_path"])
    for frame, name in zip(frames, names, strict=True):
        target = root / "images" / name
        target.parent.mkdir(exist_ok=True)
        (root / frame["file_path"]).rename(target)
        frame["file_path"] = f"images/{name}"
    edit_json(root / "transforms.json", frames=frames)


def test_nerfstudio_reads_cameras_from_names(edited):
    root = edited("nerfstudio")
    rename_frames(root, [f"cam{i}/{k:03d}.png" for i in range(2) for k in range(6)])
    capture = load_capture(root)
    assert {i: len(frames) for i, frames in capture.by_camera(capture.cameras).items()} == {0: 6, 1: 6}
    assert capture.cameras["cam1_002"].id == 1
    assert capture.cameras["cam1_002"].time == capture.cameras["cam0_002"].time == pytest.approx(0.4)


@pytest.mark.parametrize(("layout", "path"), [("nerfstudio", "transforms.json"), ("blender", "transforms_train.json")])
def test_the_field_camera_id_is_read(edited, layout, path):
    root = edited(layout)
    frames = json.loads((root / path).read_text())["frames"]
    for k, frame in enumerate(frames):
        frame["camera_id"] = 3 + k % 2
    edit_json(root / path, frames=frames)
    capture = load_capture(root)
    expected = {name: 3 + k % 2 for k, name in enumerate(sorted(capture.train))} if layout == "blender" else None
    assert {camera.id for name, camera in capture.cameras.items() if name in capture.train} == {3, 4}
    if expected:
        assert {name: capture.cameras[name].id for name in capture.train} == expected


@pytest.mark.parametrize("wrong", [None, -1, 1.5, "left", True])
def test_a_field_camera_id_that_is_not_one_is_refused(edited, wrong):
    root = edited("nerfstudio")
    frames = json.loads((root / "transforms.json").read_text())["frames"]
    for k, frame in enumerate(frames):
        frame["camera_id"] = wrong if k == 2 else 0
    edit_json(root / "transforms.json", frames=frames)
    with pytest.raises(ValueError, match=r"camera_id of images/frame_00009\.png must be a whole number from 0 on, got"):
        load_capture(root)


def test_exported_cameras_keep_their_ids(edited, tmp_path):
    root = edited("nerfstudio")
    rename_frames(root, [f"cam{i}/{k:03d}.png" for i in range(2) for k in range(6)])
    capture = load_capture(root)
    write_cameras(tmp_path, "nerfstudio", CameraSet.of(capture, np.eye(3), 1.0))
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    found = {frame["file_path"]: frame["camera_id"] for frame in frames}
    assert found == {f"images/{name}.png": camera.id for name, camera in capture.cameras.items()}


@pytest.mark.parametrize(("num_lenses", "num_cameras"), [(1, 1), (2, 2), (12, 1)])
def test_cameras_of_a_colmap_model_are_told_unless_each_image_has_its_own(edited, num_lenses, num_cameras):
    root = edited("colmap as text")
    numbers = " ".join(map(str, layouts.PARAMS))
    size = "{} {}".format(*layouts.SIZE)
    lenses = [f"{3 + i} OPENCV {size} {numbers}\n" for i in range(num_lenses)]
    (root / "sparse/0/cameras.txt").write_text("".join(lenses))
    images = [
        f"{k + 1} {' '.join(map(str, layouts.colmap_pose(k)))} {3 + k % num_lenses} {name}.png\n\n"
        for k, name in enumerate(layouts.NAMES)
    ]
    (root / "sparse/0/images.txt").write_text("".join(images))
    capture = load_capture(root)
    assert len(capture.by_camera(capture.cameras)) == num_cameras
    assert all(capture.cameras[name].id == k % num_cameras for k, name in enumerate(layouts.NAMES))
