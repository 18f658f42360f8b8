"""COLMAP models are found where programs write them, and the largest one is read."""

import shutil
import struct

import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import refused, write_array, write_png
from warpgs.captures.opening import load_capture
from warpgs.data.loaders import recognize


def smaller_model(folder, count):
    """A model of the first images of ``layouts``, as text."""
    folder.mkdir(parents=True)
    layouts.write_text_model(folder)
    path = folder / "images.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[: 1 + 2 * count]))
    return folder


def is_whole(capture):
    return len(capture.cameras) == layouts.COUNT


@pytest.mark.parametrize("binary", [False, True])
def test_the_largest_model_is_read_and_the_others_are_named(tmp_path, binary):
    root = layouts.write_colmap(tmp_path / "capture", binary)
    (root / "sparse/0").rename(root / "sparse/2")
    smaller_model(root / "sparse/0", 3)
    smaller_model(root / "sparse/10", 5)
    capture = load_capture(root)
    assert is_whole(capture)
    assert capture.notes == (
        "the COLMAP model in sparse/2 (12 images) is read as the largest; skipped: sparse/0 (3 images), "
        "sparse/10 (5 images)",
    )


def test_of_models_of_one_size_the_first_is_read(edited):
    root = edited("colmap")
    shutil.copytree(root / "sparse/0", root / "sparse/1")
    layouts.write_binary_model(root / "sparse/1", [90.0, 90.0, *layouts.PARAMS[2:]])
    capture = load_capture(root)
    assert capture.cameras["frame_00000"].K[0, 0] == layouts.FOCAL
    assert "sparse/0 (12 images) is read as the first of the largest" in capture.notes[0]


def test_a_model_that_lacks_a_file_is_not_read_if_another_is_whole(edited):
    root = edited("colmap")
    shutil.copytree(root / "sparse/0", root / "sparse/1")
    (root / "sparse/0/images.bin").unlink()
    capture = load_capture(root)
    assert is_whole(capture)
    assert "skipped: sparse/0 (0 images)" in capture.notes[0]


def test_a_damaged_count_does_not_hide_a_model(edited):
    root = edited("colmap")
    smaller = smaller_model(root / "sparse/1", 2)
    assert is_whole(load_capture(root))
    for path in smaller.iterdir():
        path.unlink()
    for name in ("cameras", "images", "points3D"):
        (smaller / f"{name}.bin").write_bytes(struct.pack("<Q", 2**60))
    assert is_whole(load_capture(root))


@pytest.mark.parametrize(
    "model", ["sparse", "sparse/0", "sparse/7", "colmap/sparse/0", "dense/sparse", "dense/0/sparse", ".", "0"]
)
def test_a_model_is_read_from_where_programs_write_it(edited, model):
    root = edited("colmap")
    shutil.move(root / "sparse/0", root / "model")
    shutil.rmtree(root / "sparse")
    shutil.copytree(root / "model", root / model, dirs_exist_ok=True)
    shutil.rmtree(root / "model")
    if model.startswith("dense"):
        part = root / model.removesuffix("/sparse")
        for name in ("images", "masks", "depths"):
            shutil.move(root / name, part / name)
    assert recognize(root) == "colmap"
    capture = load_capture(root)
    assert is_whole(capture)
    assert capture.notes == ()
    frame = capture.frame("frame_00003")
    assert np.array_equal(frame.image, layouts.image(3))
    assert np.array_equal(frame.static_mask, layouts.static_mask(3))
    assert len(capture.points) == len(layouts.POINTS)


def test_masks_of_the_images_before_undistortion_are_not_taken_for_those_after(edited):
    root = edited("colmap")
    (root / "dense").mkdir()
    for name in ("images", "sparse"):
        shutil.move(root / name, root / "dense" / name)
    capture = load_capture(root)
    assert capture.frame("frame_00003").static_mask is None
    assert capture.notes[0] == "masks is skipped: dense/images is read with dense/masks"


def test_an_undistorted_copy_is_not_preferred_to_the_images(edited):
    root = edited("colmap")
    shutil.copytree(root / "sparse/0", root / "dense/sparse")
    write_png(root / "dense/images/frame_00000.png", layouts.image(0))
    assert load_capture(root).notes[0].endswith("skipped: dense/sparse (12 images)")


def test_a_model_without_images_is_refused(edited):
    root = edited("colmap")
    shutil.move(root / "images", root / "dense/pictures")
    refused(root, "has a COLMAP model, but not the folder images/")


def test_llff_takes_points_of_the_model_that_its_poses_are_of(tmp_path):
    root = layouts.write_llff(tmp_path / "llff")
    smaller_model(root / "sparse/0", 3)
    points = root / "sparse/0/points3D.txt"
    points.write_text("1 0 0 0 9 9 9 0.5\n")
    (root / "sparse/1").mkdir()
    layouts.write_binary_model(root / "sparse/1")
    assert len(load_capture(root, "llff").points) == len(layouts.POINTS)


def test_llff_poses_beside_an_undistorted_copy_stay_llff(tmp_path):
    root = layouts.write_llff(tmp_path / "llff", motion=False)
    shutil.copytree(root / "images", root / "dense/images")
    (root / "dense/sparse").mkdir()
    layouts.write_binary_model(root / "dense/sparse")
    assert recognize(root) == "llff"
    write_array(root / "poses_bounds.npy", np.load(root / "poses_bounds.npy"))
    assert len(load_capture(root).points) == 0
