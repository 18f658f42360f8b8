"""Captures of panoramas: read, trained and evaluated over all directions."""

import dataclasses

import numpy as np
import pycolmap
import pytest
import torch

from tests import panoramas, tiny
from tests.data.captures import refused
from tests.training.test_lenses import CONFIG, psnr
from warpgs.captures.check import check_capture
from warpgs.captures.motion_check import motion_between
from warpgs.captures.opening import load_capture
from warpgs.data.lens import Lens
from warpgs.export.camera_set import CameraSet
from warpgs.export.camera_writers import write_cameras
from warpgs.files import write_png
from warpgs.video.filmed import Filmed, position_and_axis
from warpgs.viewer.pose import pose_of

WIDTH = 48


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return panoramas.write_capture(tmp_path_factory.mktemp("panoramas"), 8, WIDTH)


@pytest.mark.parametrize(
    ("direction", "pixel"),
    [((0, 0, 1), (24, 12)), ((1, 0, 0), (36, 12)), ((-1, 0, -1e-9), (12, 12)), ((0, 1, 1), (24, 18))],
)
def test_pixels_of_a_panorama_are_those_of_colmaps_model(folder, direction, pixel):
    camera = load_capture(folder).cameras["000"]
    found, _, _ = camera.place(torch.tensor([direction], dtype=torch.float64))
    assert found[0].tolist() == pytest.approx(pixel, abs=1e-5)
    other = pycolmap.Camera(model="EQUIRECTANGULAR", width=48, height=24, params=[48.0, 24.0])
    assert other.img_from_cam(np.array(direction, float)) == pytest.approx(pixel, abs=1e-5)


def test_a_pixel_shows_the_surface_that_the_camera_file_says(folder):
    """Where the writer saw a surface at a distance, the camera of the capture unprojects to it, behind it, too."""
    capture = load_capture(folder)
    _, _, distance = panoramas.frame(0.0, WIDTH)
    rows, columns = (torch.from_numpy(values).flatten() for values in np.indices(distance.shape))
    points = capture.cameras["000"].unproject(rows, columns, torch.from_numpy(0.25 * distance).flatten().float())
    x, y, z = (points / 0.25).double().abs().unbind(1)
    on_wall = torch.stack([(x - 5.0).abs(), (z - 4.0).abs(), (y - 2.0).abs(), (y - 2.5).abs()]).amin(0)
    assert (on_wall < 1e-3).double().mean() > 0.8


@pytest.mark.parametrize("form", ["nerfstudio", "colmap"])
def test_exported_panoramas_are_read_again_as_the_same_cameras(folder, tmp_path, form):
    capture = load_capture(folder)
    write_cameras(tmp_path, form, CameraSet.of(capture, np.eye(3), 1.0))
    for name in capture.cameras:
        write_png(tmp_path / f"images/{name}.png", np.zeros((WIDTH // 2, WIDTH, 3), np.uint8))
    again = load_capture(tmp_path)
    assert again.cameras["000"].distortion.lens == "equirectangular"
    assert torch.allclose(again.cameras["000"].K, capture.cameras["000"].K)
    directions = [
        torch.stack([c.cameras[name].viewmat[:3, :3] for name in sorted(capture.cameras)]) for c in (capture, again)
    ]
    assert torch.allclose(*directions, atol=1e-6)


@pytest.mark.parametrize("form", ["blender", "usd"])
def test_formats_of_pinholes_refuse_panoramas(folder, tmp_path, form):
    with pytest.raises(ValueError, match=f"--cameras {form} holds pinholes, not panoramas: use --cameras nerfstudio"):
        write_cameras(tmp_path, form, CameraSet.of(load_capture(folder), np.eye(3), 1.0))


def test_training_on_panoramas_learns_all_directions(folder, tmp_path):
    capture = load_capture(folder)
    with tiny.in_haste():
        untrained = dataclasses.replace(
            CONFIG, schedule=dataclasses.replace(CONFIG.schedule, pretrain=1, stage1=1, stage2=1)
        )
        before = psnr(capture, capture, tmp_path / "before", untrained)
        assert psnr(capture, capture, tmp_path / "after") > before + 3.0


def test_a_capture_of_panoramas_can_be_checked(folder):
    report = check_capture(folder)
    assert report.is_fit


def test_cameras_of_panoramas_fit_their_optical_flow(tmp_path):
    capture = load_capture(panoramas.write_capture(tmp_path, 9, 320))
    motion = motion_between(capture.frame("000"), capture.frame("001"))
    assert motion is not None
    assert motion.static < 0.5


def test_a_panorama_cannot_be_taken_as_a_pinhole(folder):
    refused(folder, "a panorama has no pinhole: omit --no-distortion", distortion=False)


def test_panoramas_of_more_than_all_directions_are_refused(folder):
    with pytest.raises(ValueError, match="at most 180° to the sides and 90° up and down, this one 360° and 90°"):
        _ = dataclasses.replace(Lens.panorama((48, 24)), width=96, center=(48.0, 12.0)).distortion


def test_a_viewer_sees_90_degrees_of_a_panorama_across(folder):
    pose = pose_of(load_capture(folder).cameras["000"])
    assert pose.fov == pytest.approx(2.0 * np.arctan(0.5))


def test_a_panorama_has_filmed_all_directions(folder):
    capture = load_capture(folder)
    filmed = Filmed.by(capture, capture.points)
    position, ahead = position_and_axis(capture.cameras["000"])
    assert filmed.outside(position, -ahead) <= 1.0
