"""Lenses are straightened; what a pinhole sees afterwards is where it says."""

import dataclasses

import cv2
import numpy as np
import pytest

from warpgs.data.lens import Lens, filling_zoom, pinhole_matrix, undistort

PINHOLE = Lens(160, 120, (140.0, 150.0), (83.0, 57.0))
PINCUSHION = dataclasses.replace(PINHOLE, radial=(0.25, -0.05, 0.01), tangential=(0.01, -0.02))
BARREL = dataclasses.replace(PINHOLE, radial=(-0.2, 0.03, 0.0), tangential=(0.004, 0.003))
BENT = pytest.mark.parametrize("lens", [PINCUSHION, BARREL], ids=["pincushion", "barrel"])


def taken_by(lens: Lens, color) -> np.ndarray:
    """The picture that a lens takes of a coloured plane z = 1, solved pixel by pixel: the slow way around."""
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    x, y = lens.rays(1.0, u, v)
    for _ in range(60):  # fixed point of image(x, y) = (u, v)
        seen = lens.image(x, y)
        x, y = x - (seen[0] - u) / lens.focal[0], y - (seen[1] - v) / lens.focal[1]
    assert np.abs(lens.image(x, y) - [u, v]).max() < 1e-6
    return color(x, y)


def seen_by_pinhole(lens: Lens, color) -> np.ndarray:
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    K = pinhole_matrix(lens)
    return color((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])


def grid(x, y):
    """8-bit picture of a soft grid on the plane z = 1."""
    values = 127.5 + 60 * np.cos(40 * x) + 60 * np.cos(40 * y)
    return np.repeat(values.round().astype(np.uint8)[..., None], 3, 2)


@BENT
def test_a_grid_seen_through_the_distortion_gets_straight(lens):
    straight = undistort(taken_by(lens, grid), lens).astype(int)
    truth = seen_by_pinhole(lens, grid).astype(int)
    bent = taken_by(lens, grid).astype(int)
    assert np.abs(straight - truth)[2:-2, 2:-2].max() <= 12  # interpolation of 8-bit values; half a pixel would be 45
    assert np.abs(bent - truth).max() > 100


@BENT
def test_our_model_is_opencvs_but_for_half_a_pixel(lens):
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    K = np.array([[lens.focal[0], 0, lens.center[0] - 0.5], [0, lens.focal[1], lens.center[1] - 0.5], [0, 0, 1]])
    k1, k2, k3 = lens.radial
    flat = np.concatenate([points, np.ones((50, 1))], 1)
    theirs = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), K, np.array([k1, k2, *lens.tangential, k3]))[0][:, 0]
    assert np.allclose(lens.image(*points.T).T, theirs + 0.5, atol=1e-9)


@BENT
def test_no_pixel_of_the_straight_picture_lies_outside_the_lens_picture(lens):
    zoom = filling_zoom(lens)
    assert lens.fills(zoom)
    assert zoom == 1.0 or not lens.fills(zoom - 1e-3)


def test_a_pinhole_is_left_as_it_is():
    picture = taken_by(PINHOLE, grid)
    assert undistort(picture, PINHOLE) is picture
    assert pinhole_matrix(PINHOLE).tolist() == [[140, 0, 83], [0, 150, 57], [0, 0, 1]]


def test_masks_and_depth_get_no_new_values():
    mask = seen_by_pinhole(PINHOLE, lambda x, y: x + y > 0.1)
    depth = np.where(mask, np.float32(np.nan), np.float32(2.0))
    straight = undistort(depth, BARREL)
    assert undistort(mask, BARREL).dtype == bool
    assert np.array_equal(np.isnan(straight), undistort(mask, BARREL))
    assert set(np.unique(straight[~np.isnan(straight)])) == {2.0}


def test_a_lens_that_folds_the_picture_is_refused():
    with pytest.raises(ValueError, match="too strong"):
        filling_zoom(dataclasses.replace(PINHOLE, radial=(-20.0, 0.0, 0.0)))
