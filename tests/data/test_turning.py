"""A camera that only turns is told from one that moves."""

import cv2
import numpy as np
import pytest

from warpgs.data.turning import find_turning

SIZE, FOCAL = (640, 480), 500.0


def matches(rotation: tuple, translation: tuple, outliers: float = 0.0, count: int = 200, noise: float = 0.3):
    """Positions of points at depths 2 to 8 in two frames."""
    generator = np.random.default_rng(0)
    first = generator.uniform((0, 0), SIZE, (count, 2))
    center, depth = np.array(SIZE) / 2.0, generator.uniform(2.0, 8.0, (count, 1))
    points = np.hstack([(first - center) / FOCAL, np.ones((count, 1))]) * depth
    points = points @ cv2.Rodrigues(np.array(rotation))[0].T + np.array(translation)
    second = FOCAL * points[:, :2] / points[:, 2:] + center + generator.normal(0.0, noise, (count, 2))
    second[: int(outliers * count)] += 20.0
    return first, second


def pairs(step: float, turn: float = 0.01, outliers: float = 0.0) -> list:
    return [matches((0.3 * turn * k, turn * k, 0.0), (step * k, 0.0, 0.0), outliers, 190 + k) for k in range(1, 13)]


@pytest.mark.parametrize("focal", [None, FOCAL])
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_a_camera_that_only_turns_is_recognised(focal, outliers):
    found = find_turning(pairs(0.0, outliers=outliers), SIZE, focal)
    assert found.only_turns
    assert found.explained > 0.85


@pytest.mark.parametrize("turn", [0.0, 0.01])
def test_a_camera_that_moves_does_not_only_turn(turn):
    found = find_turning(pairs(0.02, turn), SIZE)
    assert not found.only_turns
    assert found.explained < 0.5


def test_a_camera_at_rest_stands_still():
    found = find_turning(pairs(0.0, 0.0), SIZE)
    assert found.stands_still
    assert not found.only_turns


def test_few_matches_say_nothing():
    assert find_turning([matches((0, 0.01, 0), (0, 0, 0), count=20)] * 20, SIZE) is None
    assert find_turning(pairs(0.0)[:4], SIZE) is None
