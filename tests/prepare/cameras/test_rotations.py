"""Directions of a camera that only turns, from matches."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warpgs.data.lens import Lens
from warpgs.prepare.cameras import rotations
from warpgs.prepare.cameras.recovered import NoCamerasError
from warpgs.prepare.cameras.rotations import find_directions

TRUE = Lens(640, 480, (420.0, 420.0), (320.0, 240.0), (-0.08,))
UNKNOWN = Lens(640, 480, (1.0, 1.0), (320.0, 240.0))
NAMES = [f"frame_{k:06d}" for k in range(14)]


def turns() -> Rotation:
    time = np.linspace(0.0, 1.0, len(NAMES))
    return Rotation.from_rotvec(np.stack([0.1 * np.sin(5 * time), 0.8 * time, 0.05 * np.cos(4 * time)], 1))


def matches(outliers: float = 0.0, travel: float = 0.0, count: int = 60):
    """Matches of frames at most four apart, of which some are on a dynamic object."""
    random, found, rotations = np.random.default_rng(0), {}, turns()
    for a in range(len(NAMES)):
        for b in range(a + 1, min(a + 5, len(NAMES))):
            seen = random.uniform((20, 20), (620, 460), (count, 2))
            x, y = TRUE.unproject(*seen.T)
            depth = random.uniform(1.0, 4.0, (count, 1))
            points = rotations[a].inv().apply(depth * np.stack([x, y, np.ones_like(x)], 1))
            there = rotations[b].apply(points - travel * (b - a) * np.array([1.0, 0.0, 0.0]))
            other = TRUE.image(*(there[:, :2] / there[:, 2:]).T).T + random.normal(0.0, 0.3, (count, 2))
            moving = random.uniform(size=count) < outliers
            other[moving] += random.normal(0.0, 40.0, (moving.sum(), 2))
            visible = (there[:, 2] > 0.1) & (np.abs(other - (320, 240)) < (320, 240)).all(1)
            found[a, b] = seen[visible], other[visible]
    return found


def errors(cameras) -> np.ndarray:
    """Angles to the true directions, relative to the first frame [degrees]."""
    found, true = Rotation.from_matrix(cameras.poses[:, :, :3]), turns()
    return np.degrees((found * found[0].inv() * (true * true[0].inv()).inv()).magnitude())


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_directions_focal_length_and_distortion_are_found_despite_moving_objects(outliers):
    found = find_directions(NAMES, matches(outliers), UNKNOWN, finds_focal=True, finds_distortion=True)
    assert found.names == NAMES
    assert abs(found.lens.focal[0] / TRUE.focal[0] - 1.0) < 0.01
    assert abs(found.lens.coefficients[0] - TRUE.coefficients[0]) < 0.02
    assert errors(found).max() < 0.3
    assert found.error < 1.0
    assert not found.have_parallax
    assert len(found.points) == 0


def test_a_known_lens_is_kept():
    found = find_directions(NAMES, matches(0.2), TRUE, finds_focal=False, finds_distortion=False)
    assert found.lens == TRUE
    assert errors(found).max() < 0.15


def test_frames_that_no_match_connects_are_left_out():
    cut = {pair: m for pair, m in matches().items() if (pair[0] < 3) == (pair[1] < 3)}
    found = find_directions(NAMES, cut, TRUE, finds_focal=False, finds_distortion=False)
    assert found.names == NAMES[3:]


def test_a_camera_that_moves_is_refused():
    with pytest.raises(NoCamerasError, match=r"does not only turn: rotations explain \d+%|connected by rotations"):
        find_directions(NAMES, matches(travel=0.2), TRUE, finds_focal=False, finds_distortion=False)


def test_without_enough_matches_the_focal_length_must_be_given():
    with pytest.raises(NoCamerasError, match=r"give it \(--focal PX\), or use --camera still"):
        find_directions(NAMES, matches(count=16), UNKNOWN, finds_focal=True, finds_distortion=True)


def test_frames_without_matches_are_refused():
    with pytest.raises(NoCamerasError, match=r"only \d+ of 14 frames are connected"):
        find_directions(NAMES, {}, TRUE, finds_focal=False, finds_distortion=False)


def test_an_impossible_lens_is_refused_with_what_to_give(monkeypatch):
    impossible = dataclasses.replace(TRUE, coefficients=(-3.0,))  # lines through the middle fold back
    solve = rotations._Problem.solve
    monkeypatch.setattr(rotations._Problem, "solve", lambda problem, start: (solve(problem, start)[0], impossible))
    monkeypatch.setattr(rotations, "_checked_error", lambda residuals: 0.3)
    advice = r"folds back inside the image.*--focal PX.*--intrinsics FILE.*--lens SIMPLE_PINHOLE"
    with pytest.raises(NoCamerasError, match=advice):
        find_directions(NAMES, matches(), UNKNOWN, finds_focal=True, finds_distortion=True)
