"""A deformation that is fitted to dynamic points before training."""

import pytest
import torch

from tests.scenes import error, generator
from warpgs.config import ModelConfig
from warpgs.model.fields import make_deformation
from warpgs.training.dynamic_points import DynamicPoints
from warpgs.training.motion_fit import MAX_ERROR, fit_motion

NUM_VIEWS, NUM_POINTS = 21, 40
"""Frames, and points on each of two things in a frame."""
EXTENT = 2.0
TIMES = torch.linspace(0, 1, NUM_VIEWS)
COLORS = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
"""Of the two things."""
MODEL = ModelConfig(position_bands=4, time_bands=4, depth=3, width=64, skip=2, half=False)


def centers(time):
    """[2, 3] of things that change places: each comes to where the other one was."""
    angle = torch.pi * (time - 0.5)
    side = 0.3 * torch.stack([angle.cos(), angle.sin(), 0.0 * angle])
    return torch.stack([side, -side])


def points_on_balls():
    """Random points on two small balls, other ones in each frame: positions, colours and views."""
    positions, colors, views = [], [], []
    for view, time in enumerate(TIMES):
        for center, color in zip(centers(time), COLORS, strict=True):
            offsets = torch.randn(NUM_POINTS, 3, generator=generator(len(views)))
            positions.append(center + 0.05 * torch.nn.functional.normalize(offsets, dim=1))
            colors.append(color.expand(NUM_POINTS, 3))
            views.append(torch.full((NUM_POINTS,), view))
    return DynamicPoints(torch.cat(positions), torch.cat(colors), torch.cat(views), True)


FOUND = points_on_balls()


def new_deformation(seed=0):
    torch.manual_seed(seed)
    return make_deformation(MODEL, torch.zeros(3), torch.ones(3))


def fit(found, deformation, num_iterations=300):
    return fit_motion(deformation, found, TIMES, EXTENT, num_iterations, generator())


@pytest.fixture(scope="module")
def fitted():
    """Canonical points, and the deformation that was fitted to them."""
    deformation = new_deformation().requires_grad_(False)
    return fit(FOUND, deformation), deformation


@torch.no_grad()
def deformed(deformation, points, view):
    """The points of a view at canonical positions, deformed to its time."""
    positions = points.positions[points.views == view]
    return positions + deformation(positions, TIMES[view : view + 1])[:, :3]


def test_canonical_points_are_deformed_to_where_they_were_seen(fitted):
    canonical, deformation = fitted
    assert canonical.depth_known
    assert len(canonical.views) > 0.9 * len(FOUND.views)
    for view in range(NUM_VIEWS):
        seen = FOUND.positions[FOUND.views == view]
        assert torch.cdist(deformed(deformation, canonical, view), seen).amin(1).max() <= MAX_ERROR * EXTENT


def test_each_thing_is_one_cluster_in_canonical_space(fitted):
    canonical, _ = fitted
    first, second = (canonical.positions[(canonical.colors == color).all(1)] for color in COLORS)
    spread = max((points - points.mean(0)).norm(dim=1).max() for points in (first, second))
    assert spread < 0.15
    assert (first.mean(0) - second.mean(0)).norm() > 0.5


def test_a_thing_is_carried_along_its_own_way(fitted):
    canonical, deformation = fitted
    for color, thing in zip(COLORS, (0, 1), strict=True):
        points = canonical.chosen((canonical.colors == color).all(1)).positions
        for view in range(NUM_VIEWS):
            with torch.no_grad():
                moved = points + deformation(points, TIMES[view : view + 1])[:, :3]
            assert error(moved.mean(0), centers(TIMES[view])[thing]) < 0.1  # they are 0.6 apart


def test_points_that_the_deformation_does_not_reach_are_dropped():
    stray = torch.tensor([[0.0, 0.9, 0.0]]).expand(5, 3)
    with_stray = DynamicPoints(
        torch.cat([FOUND.positions, stray + 0.01 * torch.randn(5, 3, generator=generator())]),
        torch.cat([FOUND.colors, torch.full((5, 3), 0.5)]),
        torch.cat([FOUND.views, torch.full((5,), 3)]),
        True,
    )
    deformation = new_deformation()
    canonical = fit(with_stray, deformation)
    assert not (canonical.colors == 0.5).any()
    assert len(canonical.views) > 0.9 * len(FOUND.views)


def test_a_fit_is_the_same_for_the_same_random_numbers(fitted):
    canonical, deformation = fitted
    again = new_deformation()
    assert torch.equal(fit(FOUND, again).positions, canonical.positions)
    for ours, theirs in zip(again.parameters(), deformation.parameters(), strict=True):
        assert torch.equal(ours, theirs)
        assert ours.requires_grad
        assert not theirs.requires_grad


def test_points_of_a_single_frame_stay_where_they_are():
    chosen = FOUND.chosen(FOUND.views == 7)
    assert error(fit(chosen, new_deformation(), 50).positions, chosen.positions) < 0.01
