"""A 360° video becomes a capture of panoramas, whose masks and depth come from perspective views."""

import cv2
import numpy as np
import pytest

from tests import panoramas
from tests.prepare import boards
from warpgs.captures.opening import load_capture
from warpgs.data.lens import Lens
from warpgs.prepare import pipeline
from warpgs.prepare.add import AddOptions, add_parts
from warpgs.prepare.cameras.panorama import TURNS, cut, joined, view_lens
from warpgs.prepare.options import Options

COUNT, WIDTH = 14, 480


@pytest.fixture(scope="module")
def frames():
    return [panoramas.frame(k / (COUNT - 1), WIDTH) for k in range(COUNT)]


@pytest.fixture(scope="module")
def made(frames, tmp_path_factory):
    root = tmp_path_factory.mktemp("panoramas")
    source = boards.write_folder(root / "shots", [image for image, _, _ in frames])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", 384)  # views are hardly larger than the panoramas
        patch.setattr("warpgs.prepare.cameras.features.MAX_FEATURES", 1000)
        patch.setattr("warpgs.prepare.depth.estimate.MAX_SIDE", 300)
        pipeline.prepare([source], root / "made", Options(lens="EQUIRECTANGULAR"))
    return load_capture(root / "made")


def aligned(capture) -> tuple[np.ndarray, float]:
    """[F] distances of the cameras from the true ones after alignment, and scene units per world unit."""
    found = np.array([capture.cameras[name].position.double().numpy() for name in sorted(capture.cameras)])
    truth = np.array([panoramas.pose(k / (COUNT - 1))[1] for k in range(COUNT)])
    return boards.distances(found, truth), np.ptp(found, axis=0).max() / np.ptp(truth, axis=0).max()


def test_every_panorama_gets_its_true_camera(made):
    assert len(made.cameras) == COUNT
    assert all(camera.distortion.lens == "equirectangular" for camera in made.cameras.values())
    assert aligned(made)[0].max() < 0.01


def test_the_moving_board_is_masked_in_panoramas(made, frames):
    found = np.array([~made.frame(name).static_mask.numpy() for name in sorted(made.cameras)])
    true = np.array([moves for _, moves, _ in frames])
    assert found[true].mean() > 0.8
    assert found[~true].mean() < 0.01
    assert boards.overlap(found, true) > 0.6


def test_depth_of_panoramas_is_the_distance_in_all_directions(made, frames):
    frame, (_, moves, distance) = made.frame(sorted(made.cameras)[COUNT // 2]), frames[COUNT // 2]
    product = np.where(moves, np.nan, frame.inverse_depth.numpy() * distance)
    error = np.abs(product / np.nanmedian(product) - 1.0)
    for part in np.hsplit(error[WIDTH // 8 : -WIDTH // 8], 4):  # ahead, back and aside
        assert np.isfinite(part).mean() > 0.5
        assert np.nanmedian(part) < 0.05


def test_views_of_a_panorama_join_to_it():
    panorama = cv2.GaussianBlur(panoramas.frame(0.0, 240)[0].astype(np.float32).mean(2), (0, 0), 3.0)
    views = [[cut(panorama, turn, view_lens(200))] for turn in TURNS]
    (again,) = joined(views, (240, 120), cv2.INTER_LINEAR)
    assert np.abs(again - panorama)[4:-4].mean() < 1.0  # of 255


def test_a_view_ahead_shows_the_middle_of_the_panorama_and_one_to_the_right_its_right():
    panorama = np.repeat(np.arange(240, dtype=np.float32)[None], 120, 0)
    middle = [float(cut(panorama, turn, Lens.centered(50.0, (21, 21)))[10, 10]) for turn in TURNS[[0, 1, 3]]]
    assert middle == pytest.approx([119.5, 179.5, 59.5], abs=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"focal": 300.0}, "--lens EQUIRECTANGULAR says all about the lens: omit --focal"),
        ({"depth": "anything"}, "--depth anything knows no panoramas: use --depth flow or none"),
    ],
)
def test_options_that_panoramas_cannot_have_are_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        pipeline.prepare([tmp_path / "a.mp4"], tmp_path / "made", Options(lens="EQUIRECTANGULAR", **options))


def test_frames_of_another_shape_are_no_panoramas(tmp_path):
    source = boards.write_folder(tmp_path / "shots", [np.zeros((30, 40, 3), np.uint8)] * 12)
    with pytest.raises(ValueError, match="needs frames twice as wide as high, those of"):
        pipeline.prepare([source], tmp_path / "made", Options(lens="EQUIRECTANGULAR"))


def test_a_video_that_may_be_of_panoramas_is_noted(tmp_path):
    source = boards.write_folder(tmp_path / "shots", [np.zeros((30, 60, 3), np.uint8)] * 5)
    lines: list[str] = []
    with pytest.raises(ValueError, match="texture"):
        pipeline.prepare([source], tmp_path / "made", Options(masks="none"), log=lines.append)
    assert any("give --lens EQUIRECTANGULAR" in line for line in lines)


def test_parts_are_not_added_to_panoramas(tmp_path):
    root = panoramas.write_capture(tmp_path, 4, 32)
    with pytest.raises(ValueError, match="is of panoramas, whose masks and depth warpgs prepare makes from the video"):
        add_parts(root, AddOptions(["depth"]))
