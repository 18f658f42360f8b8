"""Where optical flow leads, and whether the flow back leads there and back."""

import numpy as np
import pytest

from warpgs.data.optical_flow import follow

H, W = 12, 40


def constant(x):
    """Flow of x pixels to the right everywhere."""
    return np.full((H, W, 2), (x, 0.0), np.float32)


def test_flow_leads_to_the_moved_pixel_and_out_of_the_image_to_nowhere():
    x, y, is_seen = follow(constant(3.0), constant(-3.0), 0.25)
    assert (x == np.arange(W) + 3).all()
    assert (y == np.arange(H)[:, None]).all()
    assert is_seen[:, : W - 3].all()
    assert not is_seen[:, W - 3 :].any()


@pytest.mark.parametrize(("length", "tolerance"), [(1.0, 0.25), (1.0, 1.0), (10.0, 0.25)])
def test_flow_back_may_miss_the_pixel_by_the_tolerance_and_a_twentieth_of_the_displacement(length, tolerance):
    allowed = tolerance + 0.05 * length
    for miss, agrees in ((0.99 * allowed, True), (1.01 * allowed, False)):
        _, _, is_seen = follow(constant(length), constant(miss - length), tolerance)
        assert (is_seen[:, :20] == agrees).all()
