"""The last bundle adjustment: a camera moves sideways, hardly turns, and its poses are slightly wrong at first."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from warpgs.prepare.cameras.features import Job
from warpgs.prepare.cameras.mapping import _adjusted, continuous
from warpgs.prepare.cameras.matches import all_pairs

FOCAL, MIDDLE, NUM_FRAMES = 500.0, (320.0, 240.0), 12

CENTERS = np.array([[0.1 * k, 0.05 * np.sin(k), 0.02 * k] for k in range(NUM_FRAMES)])


def points(count: int, nearest: float, farthest: float) -> np.ndarray:
    """[P, 3] points that all frames see, between two depths."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(nearest, farthest, count)
    return np.stack([rng.uniform(-0.5, 0.5, count) * depth, rng.uniform(-0.4, 0.4, count) * depth, depth], 1)


def adjusted(folder: Path, scene: np.ndarray, displaced: float = 0.0) -> Any:
    """The adjusted reconstruction; all features have noise, and a fifth are displaced sideways by some pixels."""
    pycolmap.set_random_seed(0)
    rng = np.random.default_rng(0)
    opened, model = pycolmap.Database.open(folder / "features.db"), pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    opened.write_camera(camera)
    opened.write_rig(model.rigs[1])
    for k, center in enumerate(CENTERS):
        in_camera = scene - center
        pixels = FOCAL * in_camera[:, :2] / in_camera[:, 2:] + MIDDLE + rng.normal(scale=0.3, size=(len(scene), 2))
        pixels[rng.random(len(scene)) < 0.2, 0] += displaced
        turn = Rotation.from_rotvec(rng.normal(scale=0.002, size=3))
        shift = -turn.apply(center + rng.normal(scale=0.02, size=3))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), shift)
        image = pycolmap.Image(name=f"{k:02d}.png", keypoints=pixels, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pose)
        opened.write_image(image)
        opened.write_frame(model.frames[k + 1])
        opened.write_keypoints(k + 1, pixels.astype(np.float32))
    pair = pycolmap.TwoViewGeometry()
    pair.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    pair.inlier_matches = np.tile(np.arange(len(scene), dtype=np.uint32)[:, None], 2)
    for a, b in all_pairs(NUM_FRAMES):
        opened.write_two_view_geometry(a + 1, b + 1, pair)
    opened.close()
    names = [f"{k:02d}" for k in range(NUM_FRAMES)]
    return _adjusted(Job(str(folder), names, str(folder), "SIMPLE_PINHOLE", None, False, False, FOCAL, False), model)


def turned(model: Any) -> float:
    """How far a frame is wrongly turned from the first one, at most [degrees]; none turns."""
    turns = [Rotation.from_matrix(model.images[k + 1].cam_from_world().rotation.matrix()) for k in range(NUM_FRAMES)]
    return float(np.degrees(max((turn * turns[0].inv()).magnitude() for turn in turns)))


def test_cameras_that_are_wrong_at_first_see_all_points_in_the_end(tmp_path):
    model = adjusted(tmp_path, points(200, 4.0, 8.0))
    assert min(image.num_points3D for image in model.images.values()) >= 198


def test_far_points_tell_how_the_cameras_are_turned(tmp_path):
    scene = np.concatenate([points(40, 4.0, 8.0), points(300, 60.0, 150.0)])
    model = adjusted(tmp_path, scene)
    assert turned(model) < 0.05
    assert model.num_points3D() == 40  # their own depth is imprecise


def test_features_that_are_slightly_wrong_hardly_turn_the_cameras(tmp_path):
    model = adjusted(tmp_path, points(200, 4.0, 8.0), displaced=3.5)
    assert turned(model) < 0.17  # by least squares 0.21


def in_two_parts(scales: list[float]) -> Any:
    """A reconstruction of frames that are consistent with the ones before where ``scales`` stays the same."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    scene = points(50, 4.0, 8.0)
    for k, scale in enumerate(scales):
        pixels = FOCAL * scene[:, :2] / scene[:, 2:] + MIDDLE
        image = pycolmap.Image(name=f"{k:02d}.png", keypoints=pixels, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.1 * k, 0, 0])))
        for j, position in enumerate(scene):
            track = pycolmap.Track()
            track.add_element(k + 1, j)
            model.add_point3D(scale * position, track)
    return model


def names(model: Any) -> list[str]:
    return sorted(image.name[:2] for image in model.images.values() if image.has_pose)


def test_frames_with_a_scale_of_their_own_are_removed():
    assert names(continuous(in_two_parts([1, 1, 1, 1, 100, 100]))) == ["00", "01", "02", "03"]
    assert names(continuous(in_two_parts([1, 1, 1e-3, 1e-3, 1e-3]))) == ["02", "03", "04"]


@pytest.mark.parametrize("wrong", [100.0, 1e-3, -1.0])  # -1: the frame is in front of what it sees
def test_the_frames_around_up_to_two_with_a_scale_of_their_own_stay(wrong):
    assert names(continuous(in_two_parts([1, 1, wrong, 1, 1]))) == ["00", "01", "03", "04"]
    assert names(continuous(in_two_parts([1, 1, wrong, wrong, 1]))) == ["00", "01", "04"]
    assert names(continuous(in_two_parts([1, 1, wrong, wrong, wrong, 1, 1, 1, 1]))) == ["05", "06", "07", "08"]


def test_frames_of_a_camera_that_comes_nearer_stay():
    assert len(names(continuous(in_two_parts([8, 4, 2, 1, 0.5])))) == 5


@pytest.mark.parametrize("blind", [0, 1, 3])
def test_frames_that_see_no_point_are_removed_without_those_around_them(blind):
    model = in_two_parts([1, 1, 1, 1])
    for point in [*model.images[blind + 1].points2D]:
        model.delete_point3D(point.point3D_id)
    assert names(continuous(model)) == [name for k, name in enumerate(("00", "01", "02", "03")) if k != blind]


def test_a_reconstruction_without_points_has_no_frames():
    model = in_two_parts([1, 1])
    for point in [*model.points3D]:
        model.delete_point3D(point)
    assert names(continuous(model)) == []
