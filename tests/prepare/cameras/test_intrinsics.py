"""Files of known intrinsics: what COLMAP, OpenCV and ROS write, and what is refused."""

import json
import time

import cv2
import numpy as np
import pytest

from tests.export import scenes
from warpgs.data.colmap import lens_of_parameters, parameters_of_lens
from warpgs.data.lens import Lens
from warpgs.prepare.cameras.intrinsics import read_intrinsics

K = np.array([[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
BENT = np.array([0.1, -0.02, 0.001, -0.002, 0.003])
LENS = Lens(640, 480, (500.0, 510.0), (320.0, 240.0), (0.1, -0.02, 0.001, -0.002, 0.003))
RATIONAL = Lens(640, 480, (500.0, 510.0), (320.0, 240.0), (0.1, -0.02, 0.001, -0.002, 0.003, 0.04, 0.01, 0.002))
FISHEYE = Lens(640, 480, (300.0, 310.0), (320.0, 240.0), (0.1, -0.02, 0.001, -0.002), "fisheye")

ROS = """image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [300.0, 0.0, 319.5, 0.0, 310.0, 239.5, 0.0, 0.0, 1.0]
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0.1, -0.02, 0.001, -0.002]
"""


@pytest.mark.parametrize("name", ["a.yml", "a.yaml", "a.xml", "a.json"])
def test_what_opencv_writes_is_read_with_pixels_from_the_corner(tmp_path, name):
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
    for key, value in (("camera_matrix", K), ("distortion_coefficients", BENT), ("image_width", 640)):
        storage.write(key, value)
    storage.write("image_height", 480)
    storage.release()
    assert read_intrinsics(tmp_path / name) == LENS
    assert read_intrinsics(tmp_path / name, (320, 240)) == LENS.resized(320, 240)


def test_what_ros_writes_is_read_with_its_fisheye(tmp_path):
    (tmp_path / "front.yaml").write_text(ROS)
    assert read_intrinsics(tmp_path / "front.yaml") == FISHEYE


def test_lists_without_a_size_are_of_the_frames(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"camera_matrix": K.tolist(), "distortion_coefficients": [BENT.tolist()]}))
    assert read_intrinsics(path, (640, 480)) == LENS
    assert read_intrinsics(path, (700, 500)).width == 700
    path.write_text(json.dumps({"camera_matrix": K.tolist(), "fisheye_model": 1}))
    assert read_intrinsics(path).model == "fisheye"


@pytest.mark.parametrize("lens", [LENS, FISHEYE, Lens(640, 480, (500.0, 500.0), (320.0, 240.0), (0.1,)), RATIONAL])
def test_cameras_of_colmap_are_read_and_written(tmp_path, lens):
    model, params = parameters_of_lens(lens)
    assert lens_of_parameters(model, (640, 480), params) == lens
    line = f"7 {model} 640 480 {' '.join(map(str, params))}\n"
    (tmp_path / "cameras.txt").write_text(f"# Camera list\n# a comment\n{line}")
    assert read_intrinsics(tmp_path / "cameras.txt") == lens


MATRIX = {"camera_matrix": K.tolist()}

REFUSED = [
    ("a.toml", "", "read from files that end with .txt, .json, .yaml, .yml, .xml"),
    ("a.json", "{}", "has no camera_matrix"),
    ("a.json", '{"camera_matrix": [1, 2]}', "camera_matrix must hold 9 numbers, got 2"),
    ("a.json", '{"camera_matrix": "x"}', "must hold numbers"),
    ("a.json", json.dumps({"camera_matrix": [[500, 1, 3], [0, 500, 3], [0, 0, 1]]}), "must have no skew, got 1"),
    ("a.json", json.dumps({"camera_matrix": (-K).tolist()}), "focal lengths must be at least"),
    ("a.json", json.dumps({**MATRIX, "distortion_coefficients": [0.1] * 9}), "may have k1, k2, p1, p2, k3 to k6, got"),
    ("a.json", json.dumps({**MATRIX, "image_width": 640}), "has no image_height"),
    ("a.json", json.dumps({**MATRIX, "distortion_coefficients": [-9.0]}), "folds back inside the image"),
    ("a.json", json.dumps({**MATRIX, "image_width": 480, "image_height": 640}), "480×640, the source's frames are"),
    ("a.yaml", "camera_matrix: [1, 2\n  x: }", "is not a file of OpenCV"),
    ("a.xml", "<a>", "a.xml"),
    ("a.yaml", "", "has no camera_matrix"),
    ("a.yaml", "a: " + 400_000 * "[", "nested deeper"),
    ("a.yaml", 200_000 * "{a:", "nested deeper"),
    ("a.yaml", 200_000 * "- ", "nested deeper"),
    ("a.yaml", 20_000 * "a: ", "nested deeper"),
    ("a.yaml", "camera_matrix: " + 20_000 * "- ", "nested deeper"),
    ("a.yaml", "a: " + 20_000 * "!!seq - ", "nested deeper"),
    ("a.yaml", "a:\n" + "".join(f"{k * ' '}- b: c: d:\n" for k in range(80)), "nested deeper"),
    ("a.xml", 200_000 * "<a>", "no element found"),
    ("a.xml", '<a b="x/>">' * 20_000, "no element found"),
    ("a.xml", f"<s>{20_000 * '<a'}/></s>", "not a file of OpenCV"),
    ("a.xml", f"<s>{50_000 * '<a>'}{50_000 * '</a>'}</s>", "has no camera_matrix"),
    ("a.xml", '<!DOCTYPE s [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><s>&b;</s>', "has a document type declaration"),
    ("a.xml", f"<s><camera_matrix><data>{9 * '1e999 '}</data></camera_matrix></s>", "must be finite numbers"),
    ("a.xml", f"<s><camera_matrix><data>{'9' * 5000} 0</data></camera_matrix></s>", "camera_matrix must be finite"),
    ("a.json", f'{{"camera_matrix": [{"9" * 400}]}}', "camera_matrix has more than 64 bits"),
    ("cameras.txt", f"1 PINHOLE {'9' * 400} 8 5 5 4 4\n", "image size"),
    ("cameras.txt", f"1 PINHOLE {'9' * 5000} 8 5 5 4 4\n", "an integer has thousands of digits"),
    ("a.xml", "<s><camera_matrix>1</camera_matrix><camera_matrix>2</camera_matrix></s>", "has camera_matrix twice"),
    ("cameras.txt", "# nothing\n", "must have one line"),
    ("cameras.txt", "1 PINHOLE 8 8 5 5 4 4\n2 PINHOLE 8 8 5 5 4 4\n", "must have one line"),
    ("cameras.txt", "1 FOV 8 8 5 5 4 4 0.5\n", "the camera model FOV is not supported"),
    ("cameras.txt", "1 OPENCV 8 8 5 5 4 4\n", "OPENCV has 8 parameters, got 4"),
    ("cameras.txt", "1 PINHOLE 8 8 5 nan 4 4\n", "intrinsics finite"),
    ("cameras.txt", "1 PINHOLE 8 8 5 five 4 4\n", "five"),
    ("cameras.txt", "1 PINHOLE 99999999 8 5 5 4 4\n", "image size"),
]


@pytest.mark.parametrize(("name", "text", "message"), REFUSED, ids=[str(k) for k in range(len(REFUSED))])
def test_invalid_files_are_refused_in_one_line_that_names_them(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    start = time.process_time()
    with pytest.raises(ValueError, match=message) as caught:
        read_intrinsics(tmp_path / name, (640, 480))
    assert time.process_time() - start < 2.0
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600 + len(str(tmp_path))


@pytest.mark.parametrize("name", ["no.json", "no.txt", "no.yaml"])
def test_a_missing_file_is_named(tmp_path, name):
    with pytest.raises(ValueError, match=f"{name} is missing"):
        read_intrinsics(tmp_path / name)


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    random, path = np.random.default_rng(0), tmp_path / "a.yaml"
    for _ in range(200):
        data = bytearray(ROS.encode())
        for index in random.integers(0, len(data), 3):
            data[index] = random.integers(256)
        path.write_bytes(data[: random.integers(1, len(data) + 1)])
        refusal = scenes.refusal(read_intrinsics, path)
        assert refusal is None or (str(path) in refusal and "\n" not in refusal)
