"""Intrinsics of files are those of OpenCV, and invert."""

import dataclasses

import cv2
import numpy as np
import pytest

from warpgs.cameras import Camera
from warpgs.data.lens import Lens

PINHOLE = Lens(160, 120, (140.0, 150.0), (83.0, 57.0))
PINCUSHION = dataclasses.replace(PINHOLE, coefficients=(0.25, -0.05, 0.01, -0.02, 0.01))
BARREL = dataclasses.replace(PINHOLE, coefficients=(-0.2, 0.03, 0.004, 0.003))
RATIONAL = dataclasses.replace(PINHOLE, coefficients=(0.3, 0.1, 0.004, 0.003, 0.02, 0.2, 0.05, 0.01))
FISHEYE = Lens(160, 120, (75.0, 78.0), (81.0, 58.0), (0.03, -0.01, 0.004, -0.001), "fisheye")
DISTORTED = pytest.mark.parametrize("lens", [PINCUSHION, BARREL, RATIONAL], ids=["pincushion", "barrel", "rational"])


@DISTORTED
def test_the_model_is_that_of_opencv_up_to_half_a_pixel(lens):
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    K = np.array([[lens.focal[0], 0, lens.center[0] - 0.5], [0, lens.focal[1], lens.center[1] - 0.5], [0, 0, 1]])
    on_plane = np.concatenate([points, np.ones((50, 1))], 1)
    coefficients = np.array([*lens.coefficients, *[0.0] * 8][:8])
    theirs = cv2.projectPoints(on_plane, np.zeros(3), np.zeros(3), K, coefficients)[0][:, 0]
    assert np.allclose(lens.image(*points.T).T, theirs + 0.5, atol=1e-5)


def test_zeros_at_the_end_of_the_coefficients_make_no_other_lens():
    assert dataclasses.replace(BARREL, coefficients=(*BARREL.coefficients, 0.0, 0.0)) == BARREL
    assert dataclasses.replace(PINHOLE, coefficients=(0.0, 0.0)).is_pinhole
    assert not dataclasses.replace(FISHEYE, coefficients=()).is_pinhole


@pytest.mark.parametrize("lens", [PINHOLE, PINCUSHION, FISHEYE], ids=["pinhole", "radial", "fisheye"])
def test_the_lens_of_a_camera_is_the_one_it_was_made_with(lens):
    camera = lens.camera(np.eye(3), np.array([1.0, 2.0, 3.0]), 0.25)
    assert (camera.size, camera.time, camera.position.tolist()) == ((160, 120), 0.25, [1.0, 2.0, 3.0])
    found = Lens.of(camera)
    assert (found.focal, found.center, found.model) == (lens.focal, lens.center, lens.model)
    assert found.coefficients == pytest.approx(lens.coefficients)
    assert isinstance(camera, Camera)


@pytest.mark.parametrize("lens", [PINHOLE, BARREL])
def test_depth_is_along_the_axis_but_with_a_fisheye(lens):
    assert (lens.axial_depths() == 1.0).all()


def test_depth_with_a_fisheye_is_the_distance():
    wide = dataclasses.replace(FISHEYE, focal=(36.0, 36.0))
    v, u = np.mgrid[: wide.height, : wide.width] + 0.5
    angle = np.arccos(wide.rays(u, v)[..., 2])
    depths = wide.axial_depths()
    assert np.array_equal(np.isnan(depths), ~(angle < np.pi / 2))
    assert depths[60, 90] == pytest.approx(np.cos(angle[60, 90]))


@pytest.mark.parametrize(
    ("lens", "coefficient"),
    [(PINHOLE, -20.0), (FISHEYE, -3.0), (PINHOLE, float("nan"))],
    ids=["radial", "fisheye", "nan"],
)
def test_a_lens_that_folds_back_or_is_not_finite_is_refused(lens, coefficient):
    with pytest.raises(ValueError, match=r"folds back inside the image|finite"):
        _ = dataclasses.replace(lens, coefficients=(coefficient,)).distortion


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coefficients": (float("inf"),)}, "intrinsics finite"),
        ({"focal": (1e-4, 100.0)}, "focal lengths must be at least 0.001 px"),
        ({"width": 16_385}, "image size 16385×120, expected 1 to 16384 pixels per side"),
        ({"width": 16_000, "height": 16_000}, "expected at most 100,000,000 pixels together"),
    ],
)
def test_a_lens_out_of_bounds_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PINHOLE, **changes).checked()


def test_a_resized_lens_has_the_same_view():
    small = Lens(64, 48, (50.0, 52.0), (30.0, 25.0)).resized(32, 24)
    assert small == Lens(32, 24, (25.0, 26.0), (15.0, 12.5))


def test_the_fisheye_model_is_that_of_opencv_up_to_half_a_pixel():
    points = np.append(np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2)), [[0.0, 0.0]], 0)
    K = np.array([[75.0, 0, 80.5], [0, 78.0, 57.5], [0, 0, 1]])
    theirs = cv2.fisheye.projectPoints(
        np.concatenate([points, np.ones((51, 1))], 1)[:, None],
        np.zeros(3),
        np.zeros(3),
        K,
        np.array(FISHEYE.coefficients),
    )[0][:, 0]
    assert np.allclose(FISHEYE.image(*points.T).T, theirs + 0.5, atol=1e-5)


@pytest.mark.parametrize("lens", [PINHOLE, PINCUSHION, BARREL, RATIONAL, FISHEYE])
def test_unprojecting_is_the_inverse_of_projecting(lens):
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    assert np.abs(lens.image(*lens.unproject(u, v)) - [u, v]).max() < 1e-4


def test_a_fisheye_is_inverted_up_to_its_maximum_angle():
    wide = dataclasses.replace(FISHEYE, focal=(36.0, 36.0))
    angles = np.arctan(np.hypot(*wide.unproject(np.array([81.0, 160.0]), np.array([58.0, 58.0]))))
    assert np.degrees(angles).tolist() == pytest.approx([0.0, 85.0])


@DISTORTED
def test_a_point_on_the_unit_ray_of_a_pixel_has_its_image_there(lens):
    positions = np.array([[0.5, 0.5], [90.0, 60.0], [130.2, 20.7]])
    rays = lens.unit_rays(positions)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    found = lens.image(*(rays[:, :2] / rays[:, 2:]).T).T
    assert found == pytest.approx(positions, abs=1e-4)


@pytest.mark.parametrize("lens", [Lens.centered(90.0, (64, 48)), Lens(64, 48, (90.0, 91.0), (32.0, 24.0), (0.1, 0.02))])
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_positions_in_the_image_have_the_precision_of_the_points(lens, precision):
    assert lens.image(*np.zeros((2, 3, 4), precision)).dtype == precision
    assert lens.project(np.ones((5, 3), precision)).dtype == precision
