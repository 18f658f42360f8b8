"""Depth of static surfaces from optical flow, of a video with known cameras."""

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.prepare.depth.flow import _enlarged, static_depth


@pytest.fixture(scope="module")
def planes(video, frames):
    return static_depth(frames, video[1])


def test_depth_of_the_wall_is_correct_within_two_percent(planes):
    region = np.s_[[[150], [170], [180]], [110, 120, 130]]
    errors = [planes[k][region] * boards.depth(boards.pose(k / 23))[region] - 1.0 for k in range(4, 20)]
    assert np.isfinite(errors).sum() > 50
    assert np.nanmedian(np.abs(errors)) < 0.02


def test_depth_is_unknown_in_dynamic_regions(video, planes):
    assert all(np.isnan(plane[mask]).all() for plane, mask in zip(planes, video[1], strict=True))
    assert np.mean([np.isfinite(plane).mean() for plane in planes]) > 0.5


def test_depth_is_not_interpolated_across_an_edge_or_into_the_unknown():
    plane = np.full((6, 8), 0.2, np.float32)
    plane[:, 4:], plane[0, 0] = 0.9, np.nan
    enlarged = _enlarged(plane, 16, 12)
    assert np.array_equal(enlarged, cv2.resize(plane, (16, 12), interpolation=cv2.INTER_NEAREST), equal_nan=True)
    slanted = np.tile(np.linspace(0.5, 0.6, 8, dtype=np.float32), (6, 1))
    steps = np.diff(_enlarged(slanted, 16, 12)[5, 2:-2])
    assert np.allclose(steps, steps[0], rtol=1e-3)  # within ``AGREEMENT``
