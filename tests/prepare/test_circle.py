"""The black surround of a fisheye's circular image makes no features, motion, masks or depth."""

import dataclasses

import cv2
import numpy as np
import pycolmap
import pytest

from tests.prepare import boards
from warpgs.data.lens import Lens
from warpgs.prepare.cameras.features import Job, extract_and_match
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.cameras.recovered import Cameras
from warpgs.prepare.depth.estimate import DepthMethod, add_depth
from warpgs.prepare.frames.circle import circle_in
from warpgs.prepare.frames.flow import Flows
from warpgs.prepare.masks.masker import Masker, find_masks
from warpgs.prepare.scene import write_frames

FISHEYE = Lens(*boards.SIZE, (112.0, 112.0), (130.0, 95.0), (0.04, -0.01, 0.002), "fisheye")
CENTER, RADIUS = (124.0, 98.0), 85.0


def distance() -> np.ndarray:
    """[H, W] distance from the middle of the circle."""
    return np.hypot(*np.meshgrid(np.arange(256) - CENTER[0], np.arange(192) - CENTER[1]))


@pytest.fixture(scope="module")
def images():
    """Frames whose circle has a rim that is bright, as of a lens that reflects there, and a noisy surround."""
    generator, inside = np.random.default_rng(0), (distance() < RADIUS)[..., None]
    blurred = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 0.8)[..., None]
    frames = [np.maximum(image, 40) * blurred for image in boards.through_fisheye(8, FISHEYE)]
    return [(frame + generator.uniform(0, 12, frame.shape)).clip(0, 255).astype(np.uint8) for frame in frames]


@pytest.fixture(scope="module")
def cameras():
    names = [f"{k:03d}" for k in range(8)]
    return Cameras(names, FISHEYE, boards.poses(8), boards.points(), 0.1, 10.0)


def test_the_circle_is_found_without_its_rim(images):
    shown = circle_in(images)
    assert distance()[shown].max() < RADIUS - 1.0
    assert shown[distance() < RADIUS - 6.0].all()


@pytest.mark.parametrize(
    "change",
    [
        lambda image: np.maximum(image, 60),
        lambda image: np.where((np.abs(np.arange(192) - 96) < 60)[:, None, None], np.maximum(image, 60), 0),
        lambda image: image // 16,
    ],
    ids=["no surround", "black bars", "night"],
)
def test_other_frames_have_no_circle(images, change):
    assert circle_in([change(image).astype(np.uint8) for image in images]) is None


def test_features_are_inside_the_circle(images, tmp_path):
    folder = boards.write_folder(tmp_path / "shots", images[:2])
    names = sorted(path.stem for path in folder.iterdir())
    options = {"masks": None, "thorough": False, "weak_features": True, "focal": None, "refine": False}
    job = Job(str(folder), names, str(tmp_path), "OPENCV_FISHEYE", **options)
    extract_and_match(job, lambda *_: None)
    database = pycolmap.Database.open(job.database)
    positions = np.concatenate([database.read_keypoints(image.image_id) for image in database.read_all_images()])
    database.close()
    assert len(positions) > 100
    assert np.hypot(*(positions[:, :2] - 0.5 - CENTER).T).max() < RADIUS


def test_optical_flow_observes_nothing_around_the_circle(images, cameras):
    frames = PosedFrames(images, FISHEYE, cameras.poses, cameras.points)
    for observation in frames.observations(3, Flows(frames.images, frames.expected_flow)):
        assert not observation.visible[distance() >= RADIUS].any()
        assert observation.visible[distance() < 0.6 * RADIUS].mean() > 0.5


def test_the_rim_of_the_circle_is_no_edge_of_the_images_that_are_compared(images, cameras):
    frames = PosedFrames(images, FISHEYE, cameras.poses, cameras.points)
    rim = np.abs(distance() - RADIUS) < 8.0
    before, after = (np.mean([image[rim].min() for image in some]) for some in (images, frames.images))
    assert (before < 12.0, after > 24.0) == (True, True)


def test_masks_and_depth_end_at_the_circle(images, cameras, tmp_path):
    boards.write_folder(tmp_path / "shots", images)
    folder = tmp_path / "shots"
    named = dataclasses.replace(cameras, names=sorted(path.stem for path in folder.iterdir()))
    everywhere = Masker(lambda frames, weights, quiet: [np.ones(image.shape[:2], bool) for image in frames.images])
    masks = find_masks(folder, named, everywhere, None, half_size=False, quiet=True)
    assert not any(mask[distance() > RADIUS].any() for mask in masks)
    assert all(mask[distance() < RADIUS - 8.0].all() for mask in masks)
    root = tmp_path / "made"
    write_frames(root, folder, named, [np.zeros((192, 256), bool)] * 8)
    known = DepthMethod(lambda frames, *_: [np.ones(image.shape[:2], np.float32) for image in frames.images])
    add_depth(root, [named], known, None, quiet=True)
    depth = np.load(root / f"depth/1x/{named.names[0]}.npy")
    assert np.isnan(depth[distance() > RADIUS]).all()
    assert np.isfinite(depth[distance() < RADIUS - 8.0]).all()
