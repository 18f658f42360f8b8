"""What the writer writes is read back by the loader."""

import json
import shutil

import numpy as np
import pytest
import torch

from tests.data.captures import edit_json
from warpgs.captures.opening import load_capture
from warpgs.data import writer
from warpgs.data.lens import Lens
from warpgs.data.units import SceneUnits

SIZE = (12, 8)
"""(width, height) of the images [px]."""

LENS = Lens(*SIZE, (20.0, 22.0), (6.5, 3.0))
ROTATION = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
POSITION = np.array([1.0, -2.0, 0.5])
UNITS = SceneUnits(np.array([0.5, 0.0, 1.0]), 0.25)
POINTS = np.arange(12.0).reshape(4, 3)
TIMES = {"a": 3, "b": 5, "c": 9, "d": 5}
IMAGE = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
STATIC = np.ones((SIZE[1], SIZE[0]), bool)
STATIC[2:5, 3] = False


@pytest.fixture
def root(tmp_path):
    for name in TIMES:
        writer.write_image(tmp_path, name, IMAGE, (1, 2))
        writer.write_mask(tmp_path, name, STATIC, (1, 2))
        writer.write_camera(tmp_path, name, LENS, ROTATION, POSITION)
    writer.write_scene(tmp_path, UNITS, POINTS, 0.1, 4.0)
    writer.write_index(tmp_path, TIMES, val=["d"], camera_ids={"a": 0, "b": 0, "c": 0, "d": 1})
    return tmp_path


def test_images_masks_and_points_are_read_back(root):
    capture = load_capture(root)
    frame = capture.frame("b")
    assert np.array_equal(frame.image.numpy(), IMAGE)
    assert np.array_equal(frame.static_mask.numpy(), STATIC)
    assert np.allclose(capture.points.numpy(), (POINTS - UNITS.center) * UNITS.scale)


def test_masks_that_are_gone_are_no_estimates(root):
    writer.write_index(root, TIMES, estimated_masks=True)
    shutil.rmtree(root / "resized_mask")
    assert not load_capture(root).estimated_masks


def test_the_index_says_whether_masks_are_estimates(root):
    assert not load_capture(root).estimated_masks
    writer.write_index(root, TIMES, estimated_masks=True)
    assert load_capture(root).estimated_masks
    edit_json(root / "dataset.json", masks="guessed")
    with pytest.raises(ValueError, match=r"dataset\.json: masks must be 'given' or 'estimated', got 'guessed'"):
        load_capture(root)


def test_cameras_are_read_back(root):
    camera = load_capture(root).cameras["b"]
    assert camera.size == SIZE
    assert torch.equal(camera.K, torch.tensor([[20.0, 0.0, 6.5], [0.0, 22.0, 3.0], [0.0, 0.0, 1.0]]))
    assert np.array_equal(camera.viewmat[:3, :3].numpy(), ROTATION)
    assert np.allclose(camera.position.numpy(), (POSITION - UNITS.center) * UNITS.scale)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("radial", (0.1, 0.02, 0.04, 0.05, 0.03)),
        ("radial", (0.1, 0.02, 0.04, 0.05, 0.03, 0.01, 0.02, 0.03, 0.001, 0.002, 0.003, 0.004)),
        ("fisheye", (0.1, 0.02, 0.03, 0.04)),
        ("fisheye", ()),
    ],
)
def test_distortion_is_read_back(root, model, coefficients):
    bent = Lens(*SIZE, (20.0, 20.0), (6.0, 4.0), coefficients, model)
    writer.write_camera(root, "a", bent, ROTATION, POSITION)
    found = Lens.of(load_capture(root).cameras["a"])
    assert found.model == model
    assert found.coefficients == pytest.approx(coefficients)
    if len(coefficients) == 5:
        written = json.loads((root / "camera/a.json").read_text())
        assert (written["radial_distortion"], written["tangential_distortion"]) == ([0.1, 0.02, 0.03], [0.04, 0.05])
        assert not {"rational_distortion", "prism_distortion", "fisheye_distortion"} & set(written)


def test_frames_are_split_and_ordered_by_time(root):
    capture = load_capture(root)
    assert (capture.train, capture.val) == (("a", "b", "c"), ("d",))
    assert [capture.cameras[name].time for name in TIMES] == [0.0, 2 / 6, 1.0, 2 / 6]


def test_warp_ids_count_the_distinct_times(root):
    metadata = json.loads((root / "metadata.json").read_text())
    assert [metadata[name]["warp_id"] for name in TIMES] == [0, 1, 2, 1]
    assert [metadata[name]["camera_id"] for name in TIMES] == [0, 0, 0, 1]


def test_a_reduced_mask_is_dynamic_where_any_part_is(root):
    reduced = load_capture(root, factor=2).frame("a").static_mask.numpy()
    assert np.array_equal(~reduced, (~STATIC).reshape(4, 2, 6, 2).any((1, 3)))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
def test_depth_of_every_type_is_read_back(root, dtype):
    depth = np.arange(1, SIZE[0] * SIZE[1] + 1).reshape(SIZE[1], SIZE[0]).astype(dtype)
    writer.write_depth(root, "a", depth)
    largest = 1.0 if np.dtype(dtype).kind == "f" else float(np.iinfo(dtype).max)
    assert np.allclose(load_capture(root).frame("a").inverse_depth.numpy(), depth.astype(np.float32) / largest)


def test_a_folder_without_an_index_is_not_a_capture(tmp_path):
    writer.write_scene(tmp_path, UNITS, POINTS, 0.1, 4.0)
    with pytest.raises(ValueError, match=r"dataset\.json is missing"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("times", "steps"),
    [([0.0, 0.5, 1.0], [0, 1, 2]), ([0.2, 0.3, 0.6], [0, 1, 4]), ([0.5], [0]), ([0.0, 0.0, 1.0], [0, 0, 1])],
)
def test_time_steps_are_the_smallest_whole_numbers(times, steps):
    assert writer.time_steps(times) == steps


def test_irregular_times_keep_six_digits():
    times = [0.0, 0.1234567, 0.3, 1.0]
    assert np.allclose(np.array(writer.time_steps(times)) / 10**6, times, atol=1e-6)


def test_offsets_between_cameras_are_read_back_as_written(root):
    seconds = {"a": 0.0, "b": 0.5, "c": 1.0, "d": 0.37}
    writer.write_index(root, seconds, camera_ids={"a": 0, "b": 0, "c": 0, "d": 1})
    metadata = json.loads((root / "metadata.json").read_text())
    cameras = load_capture(root).cameras
    assert [metadata[name]["time_id"] for name in TIMES] == [0, 500_000, 1_000_000, 370_000]
    assert {name: cameras[name].time for name in TIMES} == pytest.approx(seconds)
    assert [cameras[name].id for name in TIMES] == [0, 0, 0, 1]


def test_times_before_0_are_written_from_the_first_on(root):
    writer.write_index(root, {"a": -2, "b": 0, "c": 4, "d": 1})
    metadata = json.loads((root / "metadata.json").read_text())
    assert [metadata[name]["time_id"] for name in TIMES] == [0, 2, 6, 3]
