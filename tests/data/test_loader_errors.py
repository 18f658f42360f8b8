"""Invalid captures are refused in one line that names the file and what was expected."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.data.captures import edit_json, refused, write_array, write_capture, write_json
from warpgs.captures.opening import load_capture
from warpgs.config import MaskPerturbation
from warpgs.data.writer import FINISHED, STATE, WORK


def test_the_given_dataset_overrides_recognition(root):
    shutil.copytree(root / "rgb/1x", root / "rgb/2x")
    refused(root, r"resized_mask.2x is missing", dataset="hypernerf")


def test_a_damaged_colmap_model_is_refused(root):
    (root / "points.npy").unlink()
    (root / "sparse/0").mkdir(parents=True)
    refused(root, r"sparse.0 is not a COLMAP model")


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((4, 2)), np.zeros(3), np.full((4, 3), np.nan)])
def test_invalid_points_are_refused(root, points):
    write_array(root / "points.npy", points)
    refused(root, r"points\.npy must hold finite points")


BAD_CAMERAS = [
    ({"orientation": [[1, 0], [0, 1]]}, "orientation"),
    ({"orientation": np.diag([1, 1, -1]).tolist()}, "not a rotation"),
    ({"position": [0, float("nan"), 0]}, "position"),
    ({"position": "far"}, "position"),
    ({"focal_length": None}, "no focal_length"),
    ({"focal_length": -5}, "focal lengths must be at least"),
    ({"focal_length": 10**400}, "focal_length"),
    ({"focal_length": 1e30}, "focal_length must be at most"),
    ({"focal_length": 1e-30}, "focal lengths must be at least"),
    ({"pixel_aspect_ratio": 0}, "focal lengths must be at least"),
    ({"focal_length": "12.5"}, "focal_length must hold numbers"),
    ({"focal_length": True}, "focal_length must hold numbers"),
    ({"orientation": [[1, 0, 0], [0, 1]]}, "orientation must hold numbers"),
    ({"principal_point": [1]}, "principal_point"),
    ({"skew": 0.1}, "skew"),
    ({"radial_distortion": [1, 2, 3, 4]}, "radial_distortion"),
    ({"radial_distortion": [-500, 0, 0]}, "folds back inside the image"),
    ({"radial_distortion": {"k1": 1}}, "radial_distortion"),
    ({"image_size": [10**9, 10]}, "image size 1000000000×10"),
    ({"image_size": [0, 10]}, "image size 0×10"),
    ({"image_size": [16000, 16000]}, "image size 16000×16000"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_CAMERAS, ids=[str(k) for k in range(len(BAD_CAMERAS))])
def test_a_bad_camera_is_refused_by_file_and_what_is_wrong(root, changes, message):
    edit_json(root / "camera/right_000002.json", **changes)
    refused(root, rf"right_000002\.json.*{message}")


@pytest.mark.parametrize("text", ["", "{", "[]", "[" * 100_000, '{"a": ' + "9" * 5000 + "}", "\udcff"])
@pytest.mark.parametrize("name", ["dataset.json", "metadata.json", "scene.json", "camera/left_000000.json"])
def test_bad_json_is_refused_by_file(root, name, text):
    (root / name).write_bytes(text.encode(errors="surrogateescape"))
    refused(root, rf"{name} (is not valid JSON|must hold a JSON object)")


@pytest.mark.parametrize("path", ["metadata.json", "scene.json", "camera/left_000000.json", "rgb/1x/left_000003.png"])
def test_a_missing_file_is_refused_by_name(root, path):
    (root / path).unlink()
    refused(root, rf"{path} is missing")


def test_a_missing_mask_of_a_training_frame_is_refused_on_opening(root):
    (root / "resized_mask/1x/left_000001.png.png").unlink()
    with pytest.raises(ValueError, match=r"left_000001\.png\.png is missing: every training frame"):
        load_capture(root)


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("..", "has no dataset.json and the files of no other layout .*colmap.*; warpgs prepare makes a capture"),
        ("rgb", "rgb is a part of a capture: give "),
        ("rgb/1x", "1x is a part of a capture: give "),
        (
            "scene.json",
            "is a file: give the folder of the capture; warpgs prepare .*scene.json CAPTURE --holdout 8 makes",
        ),
        ("nowhere", "nowhere does not exist"),
    ],
)
def test_what_has_no_part_of_a_capture_is_refused(root, folder, message):
    refused(root / folder, message)


def test_a_folder_of_images_is_told_what_makes_a_capture_of_them(tmp_path):
    (tmp_path / "a.JPG").write_bytes(b"")
    refused(tmp_path, f"has images, but no cameras: warpgs prepare {tmp_path} CAPTURE --holdout 8 makes a capture")


def test_a_misspelt_capture_is_told_the_name_that_is_similar(root):
    refused(root.with_name(root.name + "s"), rf"does not exist; did you mean {re.escape(str(root))}\?$")


@pytest.mark.parametrize("name", ["builtin", "studio"])
def test_a_built_in_capture_without_its_prefix_is_told_the_names(name):
    refused(Path(name), f"{name} does not exist; built-in captures are builtin:room, ")


def test_a_capture_that_prepare_has_not_finished_is_refused(root):
    write_json(root / WORK / STATE, {"options": {"source": "/my clip.mp4"}, "done": {"capture": {}}})
    message = (
        r"is not finished: .* \(warpgs prepare '/my clip\.mp4' .*, with its options\); or remove .*\.prepare to use"
    )
    for dataset in (None, "nerfds"):
        refused(root, message, dataset=dataset)
    write_json(root / WORK / STATE, {"done": {"capture": {}, FINISHED: {}}})
    assert load_capture(root).train


@pytest.mark.parametrize(
    ("state", "sources"), [({"options": {"source": ["a.mp4", "b.mp4"]}, "done": {}}, "a.mp4 b.mp4"), (None, "VIDEO")]
)
def test_a_preparation_that_was_interrupted_before_it_wrote_a_capture_is_told_how_it_goes_on(tmp_path, state, sources):
    (tmp_path / WORK / "new").mkdir(parents=True)
    if state is not None:
        write_json(tmp_path / WORK / STATE, state)
    refused(
        tmp_path,
        rf"is not finished: warpgs prepare was interrupted.* \(warpgs prepare {sources} .*, with its options\)$",
    )


def test_a_run_folder_is_not_taken_for_a_capture(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    refused(tmp_path, "is a run folder: give the capture that it was trained on; warpgs train --resume")


def test_a_model_without_its_images_is_named(tmp_path):
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/cameras.txt").write_text("")
    refused(tmp_path, "has a COLMAP model, but not the folder images/")


def test_the_error_for_a_part_of_a_capture_lists_its_files(root):
    (root / "dataset.json").unlink()
    refused(root, "dataset.json is missing: a capture has .*camera")


@pytest.mark.usefixtures("contracts_off")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"factor": 4}, r"rgb.4x is missing: .* has 1x, --factor"),
        ({"factor": 0}, "factor must be at least 1, got 0"),
        ({"dataset": "blend"}, "dataset must be one of iphone, nerfds, hypernerf, nerfstudio.*, got 'blend'"),
        ({"perturbation": MaskPerturbation(erode=-1)}, "erode"),
    ],
)
def test_a_bad_option_is_refused_on_opening(root, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_capture(root, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ids", [[], "left", [1, 2], ["../up"], ["left_000000"] * 2, ["right_000000"], [""]])
def test_bad_training_ids_are_refused(root, ids):
    edit_json(root / "dataset.json", train_ids=ids)
    refused(root, r"dataset\.json")


@pytest.mark.parametrize(("val", "some"), [([], "some$"), (["right_000000"], "some of the 1 frame to evaluate on")])
def test_without_training_frames_the_list_that_lacks_them_is_named(root, val, some):
    edit_json(root / "dataset.json", train_ids=None, val_ids=val)
    refused(root, rf"dataset\.json has no frames to train on: its train_ids must list {some}")


def test_a_split_of_an_iphone_without_training_frames_is_named(tmp_path):
    root = write_capture(tmp_path / "toy", "iphone")
    write_json(root / "splits/train.json", {"frame_names": []})
    refused(root, r"splits.train\.json has no frames to train on: its frame_names must list some of the 2 frames to")


@pytest.mark.parametrize("step", [None, -1, float("nan"), "first", True])
def test_a_frame_without_a_time_is_refused(root, step):
    metadata = json.loads((root / "metadata.json").read_text())
    metadata["left_000001"] = {"time_id": step}
    write_json(root / "metadata.json", metadata)
    refused(root, r"metadata\.json has no time_id or warp_id for frame left_000001")


BAD_UNITS = [{"center": [0, 0]}, {"center": [1e300, 0, 0]}, *({"scale": s} for s in (0, float("inf"), None, 1e30))]


@pytest.mark.parametrize("scene", [{}, *BAD_UNITS])
def test_bad_scene_units_are_refused(root, scene):
    write_json(root / "scene.json", scene and {"center": [0, 0, 0], "scale": 1.0, **scene})
    refused(root, rf"scene\.json(:| has no) {next(iter(scene), 'scale')}")


@pytest.mark.parametrize("value", [1e300, 1e30, -1e10])
def test_points_too_far_away_are_refused(root, value):
    write_array(root / "points.npy", np.full((4, 3), value))
    refused(root, r"points\.npy: positions must be finite and at most 1e\+09 scene units")


def test_a_camera_too_far_away_is_refused(root):
    write_json(root / "scene.json", {"center": [0, 0, 0], "scale": 1e8})
    edit_json(root / "camera/right_000002.json", position=[1e8, 0, 0])
    refused(root, r"right_000002\.json: positions must be finite and at most 1e\+09 scene units")


def test_a_truncated_image_is_refused_when_it_is_read(root):
    path = root / "rgb/1x/left_000001.png"
    path.write_bytes(path.read_bytes()[:-20])
    refused(root, r"left_000001\.png is truncated")
