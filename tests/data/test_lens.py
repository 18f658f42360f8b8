"""Undistorted images are those of the pinhole camera that goes with them."""

import dataclasses

import cv2
import numpy as np
import pytest

from warpgs.data.lens import Lens, filling_zoom, pinhole_matrix, undistort

PINHOLE = Lens(160, 120, (140.0, 150.0), (83.0, 57.0))
PINCUSHION = dataclasses.replace(PINHOLE, radial=(0.25, -0.05, 0.01), tangential=(0.01, -0.02))
BARREL = dataclasses.replace(PINHOLE, radial=(-0.2, 0.03, 0.0), tangential=(0.004, 0.003))
FISHEYE = Lens(160, 120, (75.0, 78.0), (81.0, 58.0), fisheye=(0.03, -0.01, 0.004, -0.001))
DISTORTED = pytest.mark.parametrize("lens", [PINCUSHION, BARREL], ids=["pincushion", "barrel"])


def image_through(lens: Lens, color) -> np.ndarray:
    """The image of a coloured plane z = 1, with the distortion inverted pixel by pixel."""
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    x, y = lens.rays(1.0, u, v)
    for _ in range(60):  # fixed point of image(x, y) = (u, v)
        projected = lens.image(x, y)
        x, y = x - (projected[0] - u) / lens.focal[0], y - (projected[1] - v) / lens.focal[1]
    assert np.abs(lens.image(x, y) - [u, v]).max() < 1e-6
    return color(x, y)


def image_of_pinhole(lens: Lens, color) -> np.ndarray:
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    K = pinhole_matrix(lens)
    return color((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])


def grid(x, y):
    """8-bit colours of a soft grid on the plane z = 1."""
    values = 127.5 + 60 * np.cos(40 * x) + 60 * np.cos(40 * y)
    return np.repeat(values.round().astype(np.uint8)[..., None], 3, 2)


@DISTORTED
def test_undistorting_a_grid_gives_the_image_of_the_pinhole(lens):
    undistorted = undistort(image_through(lens, grid), lens).astype(int)
    truth = image_of_pinhole(lens, grid).astype(int)
    distorted = image_through(lens, grid).astype(int)
    assert np.abs(undistorted - truth)[2:-2, 2:-2].max() <= 12  # rounded and interpolated; half a pixel would be 45
    assert np.abs(distorted - truth).max() > 100


@DISTORTED
def test_the_model_is_that_of_opencv_up_to_half_a_pixel(lens):
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    K = np.array([[lens.focal[0], 0, lens.center[0] - 0.5], [0, lens.focal[1], lens.center[1] - 0.5], [0, 0, 1]])
    k1, k2, k3 = lens.radial
    on_plane = np.concatenate([points, np.ones((50, 1))], 1)
    theirs = cv2.projectPoints(on_plane, np.zeros(3), np.zeros(3), K, np.array([k1, k2, *lens.tangential, k3]))[0][:, 0]
    assert np.allclose(lens.image(*points.T).T, theirs + 0.5, atol=1e-9)


@DISTORTED
def test_every_pixel_of_the_undistorted_image_has_a_source_pixel(lens):
    zoom = filling_zoom(lens)
    assert lens.covers(zoom)
    assert zoom == 1.0 or not lens.covers(zoom - 1e-3)


def test_the_image_of_a_pinhole_is_unchanged():
    image = image_through(PINHOLE, grid)
    assert undistort(image, PINHOLE) is image
    assert pinhole_matrix(PINHOLE).tolist() == [[140, 0, 83], [0, 150, 57], [0, 0, 1]]


def test_the_lens_of_intrinsics_has_these_intrinsics():
    assert Lens.pinhole(pinhole_matrix(PINHOLE), (PINHOLE.width, PINHOLE.height)) == PINHOLE


def test_masks_and_depth_get_no_new_values():
    mask = image_of_pinhole(PINHOLE, lambda x, y: x + y > 0.1)
    depth = np.where(mask, np.float32(np.nan), np.float32(2.0))
    undistorted = undistort(depth, BARREL)
    assert undistort(mask, BARREL).dtype == bool
    assert np.array_equal(np.isnan(undistorted), undistort(mask, BARREL))
    assert set(np.unique(undistorted[~np.isnan(undistorted)])) == {2.0}


def test_a_distortion_that_is_not_invertible_is_refused():
    with pytest.raises(ValueError, match="too strong"):
        filling_zoom(dataclasses.replace(PINHOLE, radial=(-20.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
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
        np.concatenate([points, np.ones((51, 1))], 1)[:, None], np.zeros(3), np.zeros(3), K, np.array(FISHEYE.fisheye)
    )[0][:, 0]
    assert np.allclose(FISHEYE.image(*points.T).T, theirs + 0.5, atol=1e-9)


@pytest.mark.parametrize("lens", [PINHOLE, PINCUSHION, BARREL, FISHEYE], ids=["pinhole", "in", "out", "fisheye"])
def test_unprojecting_is_the_inverse_of_projecting(lens):
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    assert np.abs(lens.image(*lens.unproject(u, v)) - [u, v]).max() < 1e-4


def test_a_fisheye_is_inverted_up_to_its_maximum_angle():
    wide = dataclasses.replace(FISHEYE, focal=(30.0, 30.0))
    angles = np.arctan(np.hypot(*wide.unproject(np.array([81.0, 160.0]), np.array([58.0, 58.0]))))
    assert np.degrees(angles).tolist() == pytest.approx([0.0, 85.0])


def test_undistorting_a_fisheye_gives_the_image_of_the_pinhole():
    def color(x, y):
        return np.repeat((127.5 + 60 * np.cos(9 * x) + 60 * np.cos(9 * y)).round().astype(np.uint8)[..., None], 3, 2)

    v, u = np.mgrid[: FISHEYE.height, : FISHEYE.width] + 0.5
    undistorted = undistort(color(*FISHEYE.unproject(u, v)), FISHEYE).astype(int)
    assert not FISHEYE.is_pinhole
    assert np.abs(undistorted - image_of_pinhole(FISHEYE, color)).max() <= 6


def test_a_fisheye_that_is_not_invertible_is_refused():
    with pytest.raises(ValueError, match=r"too strong to undistort: \(-3.0,"):
        dataclasses.replace(FISHEYE, fisheye=(-3.0, 0.0, 0.0, 0.0)).checked()


@DISTORTED
def test_a_point_on_the_unit_ray_of_a_pixel_has_its_image_there(lens):
    positions = np.array([[0.5, 0.5], [90.0, 60.0], [130.2, 20.7]])
    rays = lens.unit_rays(positions)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    found = lens.image(*(rays[:, :2] / rays[:, 2:]).T).T
    assert found == pytest.approx(positions, abs=1e-4)
