"""Triangulation from exact, wrong and missing positions."""

import numpy as np
import pytest

from warpgs.prepare.cameras.triangulation import Observation, fill_unknown, triangulate


def observation(rho: float, rotation: np.ndarray, translation: np.ndarray) -> Observation:
    ray = np.array([0.1, -0.2, 1.0], np.float32)
    rotated = (rotation @ ray).astype(np.float32)
    point = rotated + rho * translation
    position = np.broadcast_to((point[:2] / point[2])[:, None, None], (2, 1, 1)).astype(np.float32)
    return Observation(position, rotated[:, None, None], translation.astype(np.float32), np.ones((1, 1), bool))


def test_depth_is_exact_for_exact_positions():
    translations = [np.array([0.3, 0.0, 0.1]), np.array([-0.2, 0.1, 0.0])]
    found = triangulate([observation(0.4, np.eye(3), t) for t in translations], 200.0)
    assert found.inverse_depth.item() == pytest.approx(0.4, rel=1e-3)
    assert found.residual.item() < 1e-2


def test_one_wrong_position_among_many_is_outvoted():
    translations = map(np.array, ([0.3, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.2, 0.2, 0.0]))
    wrong = observation(3.0, np.eye(3), np.array([0.25, 0.0, 0.0]))
    found = triangulate([*(observation(0.4, np.eye(3), t) for t in translations), wrong], 200.0)
    assert found.inverse_depth.item() == pytest.approx(0.4, rel=0.05)


def test_a_pixel_that_only_one_frame_sees_has_no_depth():
    found = triangulate([observation(0.4, np.eye(3), np.array([0.3, 0.0, 0.0]))], 200.0)
    assert np.isnan(found.inverse_depth).all()


def test_unknown_pixels_are_filled_from_the_nearest():
    plane = np.full((3, 5), np.nan, np.float32)
    assert not fill_unknown(plane).any()
    plane[1, 0], plane[1, 4] = 2.0, 7.0
    assert fill_unknown(plane)[1].tolist()[:2] == [2.0, 2.0]
    assert fill_unknown(plane)[1].tolist()[3:] == [7.0, 7.0]
