"""The files of a capture, and its scene units."""

import dataclasses
import json

import numpy as np
import pytest

from tests.prepare import boards
from warpgs.captures.opening import load_capture
from warpgs.data.lens import Lens
from warpgs.data.loaders import recognize
from warpgs.prepare.cameras.recovered import Cameras
from warpgs.prepare.frames.take import Frames, SourceFrame
from warpgs.prepare.scene import are_static, scene_units, write_capture, write_frames, write_scene


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return boards.write_capture(tmp_path_factory.mktemp("scene"), holdout=4)


def test_a_written_capture_is_read_back_as_nerf_ds(root):
    capture = load_capture(root)
    assert recognize(root) == "nerfds"
    name = capture.train[3]
    frame, k = capture.frame(name), int(name.removeprefix("shot"))
    images, masks = boards.record(16)
    assert np.array_equal(frame.image.numpy(), images[k])
    assert np.array_equal(frame.static_mask.numpy(), ~masks[k])
    scene = json.loads((root / "scene.json").read_text())
    center = -boards.poses(16)[k, :, :3].T @ boards.poses(16)[k, :, 3]
    expected = (center - np.array(scene["center"])) * scene["scale"]
    assert np.allclose(frame.camera.position.numpy(), expected, atol=1e-5)


def test_half_size_is_read_with_factor_2_and_partly_dynamic_pixels_count_as_dynamic(root):
    capture = load_capture(root, factor=2)
    name = capture.train[3]
    frame, mask = capture.frame(name), boards.record(16)[1][int(name.removeprefix("shot"))]
    blocks = mask.reshape(mask.shape[0] // 2, 2, mask.shape[1] // 2, 2)
    assert np.array_equal(~frame.static_mask.numpy(), blocks.any((1, 3)))
    assert recognize(root) == "nerfds"
    assert frame.camera.K[0, 0].item() == pytest.approx(boards.FOCAL / 2)


def test_every_fourth_frame_is_held_out(root):
    capture = load_capture(root)
    assert len(capture.val) == 4
    assert not set(capture.val) & set(capture.train)
    assert min(capture.cameras[n].time for n in capture.train) == 0.0


def test_the_scene_is_in_the_unit_cube(root):
    capture = load_capture(root)
    assert float(capture.points.abs().quantile(0.95)) <= 1.0
    assert float(capture.points.abs().max()) > 0.8
    assert all(float(camera.position.abs().max()) <= 1.0 + 1e-5 for camera in capture.cameras.values())


def test_outlier_points_do_not_shrink_the_scene():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    with_outliers = np.vstack([points, np.full((5, 3), 1e4)])
    expected = scene_units(points, points[:5]).scale
    assert scene_units(with_outliers, points[:5]).scale == pytest.approx(expected, rel=0.1)


def test_a_crowd_of_points_at_one_place_does_not_enlarge_the_scene():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    crowded = np.vstack([points, np.zeros((100_000, 3))])
    expected = scene_units(points, points[:5]).scale
    assert scene_units(crowded, points[:5]).scale == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("model", ["radial", "fisheye"])
def test_frames_and_masks_are_written_as_they_were_recorded_with_their_lens(model, tmp_path):
    images, masks = boards.record(16)
    frames = boards.write_folder(tmp_path / "frames", images)
    names = [path.stem for path in sorted(frames.iterdir())]
    cameras = boards.true_cameras(frames, names)
    lens = dataclasses.replace(cameras.lens, coefficients=(0.05, -0.01), model=model)
    write_frames(tmp_path / "made", frames, dataclasses.replace(cameras, lens=lens), masks)
    write_scene(tmp_path / "made", [cameras], cameras.points, {name: k for k, name in enumerate(names)})
    frame = load_capture(tmp_path / "made").frame(names[3])
    assert np.array_equal(frame.image.numpy(), images[3])
    assert np.array_equal(~frame.static_mask.numpy(), masks[3])
    found = Lens.of(frame.camera)
    assert (found.focal, found.model) == (pytest.approx(lens.focal), model)
    assert found.coefficients == pytest.approx((0.05, -0.01))


@pytest.mark.parametrize(
    ("sides", "written", "is_noted"),
    [(["left"], "left", False), (["top"], "top", False), (["left", "top"], "top", True)],
)
def test_the_side_where_the_readout_of_rotated_videos_begins_is_written(sides, written, is_noted, tmp_path):
    images, masks = boards.record(6)
    folder = boards.write_folder(tmp_path / "frames", images)
    names = [path.stem for path in sorted(folder.iterdir())]
    taken = [SourceFrame(name, name, k, k) for k, name in enumerate(names)]
    videos = [Frames(folder, taken, *boards.SIZE, 1.0, readout_from=side) for side in sides]
    cameras = [boards.true_cameras(folder, names)]
    _, notes = write_capture(tmp_path / "made", videos, cameras, lambda _: masks, estimated=False, val=[])
    assert load_capture(tmp_path / "made").readout_from == written
    assert any("begins at the left, top of their" in note for note in notes) == is_noted


def test_points_in_dynamic_regions_are_omitted():
    poses = np.tile(np.hstack([np.eye(3), np.zeros((3, 1))]), (4, 1, 1))
    points = np.array([[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [0.0, 0.0, -2.0]])
    cameras = Cameras(list("abcd"), boards.lens(), poses, points, 0.1, 9.0)
    dynamic = np.zeros((4, 192, 256), bool)
    dynamic[:3, 90:100, 120:136] = True
    assert are_static(points, [(cameras, list(dynamic))]).tolist() == [False, True, True]


def test_cameras_are_saved_and_loaded(tmp_path):
    cameras = Cameras(["a", "b"], boards.lens(), boards.poses(2), boards.points(7), 0.5, 8.0, False, True)
    cameras.save(tmp_path / "cameras")
    loaded = Cameras.load(tmp_path / "cameras")
    assert (loaded.names, loaded.lens, loaded.angle) == (cameras.names, cameras.lens, cameras.angle)
    assert (loaded.weak_features, loaded.has_held_focal) == (False, True)
    assert np.array_equal(loaded.poses, cameras.poses)
