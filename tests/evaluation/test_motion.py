"""Jitter: how far dynamic Gaussians leave their way between two training frames."""

import pytest
import torch

from tests import tiny
from warpgs.evaluation.motion import jitter
from warpgs.model.splats import Splats
from warpgs.runs.run import Run


def moving(path):
    """Two static Gaussians and two dynamic ones, the second one transparent, of which the first follows a path."""

    def splats_at(time):
        x, y = path(time)
        means = torch.tensor([[9.0, 9.0 * time, 9.0], [0.0, 0.0, 0.0], [x, y, 1.0], [7.0 * time**3, 0.0, 0.0]])
        opacities, is_dynamic = torch.tensor([1.0, 1.0, 0.6, 0.0]), torch.tensor([False, False, True, True])
        ones = torch.ones(4, 3)
        return Splats(means, torch.ones(4, 4), ones, opacities, colors=ones, is_dynamic=is_dynamic)

    return splats_at


def test_straight_motion_at_constant_speed_has_no_jitter():
    assert jitter(moving(lambda t: (2.0 * t, -t)), [0.0, 0.25, 0.5, 1.0]) == pytest.approx(0.0, abs=1e-6)


def test_jitter_is_the_deviation_halfway_relative_to_the_way():
    """x = t²: from 0 to 1 the way is 1, and the middle is at 1/4 instead of 1/2."""
    assert jitter(moving(lambda t: (t * t, 0.0)), [0.0, 1.0]) == pytest.approx(0.25)


def test_detours_between_frames_are_jitter():
    """The point is on its way at the frames and 1 beside it halfway between them."""
    frames = {0.0: (0.0, 0.0), 0.5: (1.0, 0.0), 1.0: (2.0, 0.0), 0.25: (0.5, 1.0), 0.75: (1.5, 1.0)}
    assert jitter(moving(frames.__getitem__), [1.0, 0.0, 0.5, 0.5]) == pytest.approx(1.0)


def test_jitter_shrinks_with_the_distance_of_frames():
    circle = moving(lambda t: (torch.tensor(6.0 * t).cos().item(), torch.tensor(6.0 * t).sin().item()))
    coarse, fine = (jitter(circle, [k / n for k in range(n + 1)]) for n in (8, 32))
    assert fine < coarse / 3


@pytest.mark.parametrize("times", [[], [0.5], [0.5, 0.5]])
def test_jitter_needs_two_times(times):
    assert jitter(moving(lambda t: (t, t)), times) is None


def test_without_motion_there_is_no_jitter():
    assert jitter(moving(lambda t: (1.0, 1.0)), [0.0, 1.0]) is None


def test_jitter_of_a_trained_scene_is_measured(tmp_path):
    scene = Run.open(tiny.finished(tmp_path), "cpu").trained_scene()
    assert 0.0 < jitter(scene.splats, [0.0, 0.5, 1.0]) < 10.0
