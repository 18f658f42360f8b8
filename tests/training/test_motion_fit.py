"""A deformation that is fitted to dynamic points before training."""

import pytest
import torch

from tests.scenes import error, generator
from warpgs.config import ModelConfig
from warpgs.model.fields import make_deformation
from warpgs.training import motion_fit
from warpgs.training.dynamic_points import DynamicPoints
from warpgs.training.motion_fit import MAX_ERROR, fit_motion

NUM_VIEWS, NUM_POINTS = 21, 40
"""Frames, and points on each of two objects in a frame."""
EXTENT = 2.0
TIMES = torch.linspace(0, 1, NUM_VIEWS)
COLORS = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
"""Colours of the two objects."""
MODEL = ModelConfig(position_bands=4, time_bands=4, depth=3, width=64, skip=2, half=False)


def centers(time):
    """[2, 3] of objects that change places: each comes to where the other one was."""
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


def test_each_object_is_one_cluster_in_canonical_space(fitted):
    canonical, _ = fitted
    first, second = (canonical.positions[(canonical.colors == color).all(1)] for color in COLORS)
    spread = max((points - points.mean(0)).norm(dim=1).max() for points in (first, second))
    assert spread < 0.15
    assert (first.mean(0) - second.mean(0)).norm() > 0.5


def test_an_object_is_carried_along_its_own_way(fitted):
    canonical, deformation = fitted
    for color, label in zip(COLORS, (0, 1), strict=True):
        points = canonical.chosen((canonical.colors == color).all(1)).positions
        for view in range(NUM_VIEWS):
            with torch.no_grad():
                moved = points + deformation(points, TIMES[view : view + 1])[:, :3]
            assert error(moved.mean(0), centers(TIMES[view])[label]) < 0.1  # they are 0.6 apart


def beside(center, views):
    """Grey points on a third ball in some frames, and the others."""
    positions = torch.tensor(center) + 0.02 * torch.randn(20 * len(views), 3, generator=generator())
    views = torch.tensor(views).repeat_interleave(20)
    third = DynamicPoints(positions, torch.full_like(positions, 0.5), views, True)
    parts = zip(FOUND[:3], third[:3], strict=True)
    return DynamicPoints(*(torch.cat(part) for part in parts), True)


@pytest.mark.parametrize("x", [-0.2, 0.0, 0.2, 0.8])
def test_an_object_that_no_canonical_frame_shows_keeps_its_points(x):
    points, deformation = beside([x, 0.0, 0.7], [16, 17, 18, 19, 20]), new_deformation()
    canonical = fit(points, deformation)
    grey = canonical.chosen((canonical.colors == 0.5).all(1))
    assert len(grey.views) > 0.7 * 5 * 20
    for view in (16, 20):
        seen = points.positions[(points.views == view) & (points.colors == 0.5).all(1)]
        assert torch.cdist(deformed(deformation, grey, view), seen).amin(1).max() <= MAX_ERROR * EXTENT


def test_points_that_the_deformation_does_not_reach_are_dropped():
    class Folded(torch.nn.Module):
        """It moves everything to negative x, so that it cannot reach half of the points."""

        def __init__(self):
            super().__init__()
            self.scale = torch.nn.Parameter(torch.zeros(()))

        def forward(self, means, time):
            offsets = torch.zeros(len(means), 10)
            offsets[:, 0] = -2.0 * means[:, 0].clamp_min(0.0) * (time != TIMES[10])
            return offsets + 0.0 * self.scale

    canonical = fit(FOUND, Folded(), 2)
    assert not ((canonical.positions[:, 0] > 0.2) & (canonical.views != 10)).any()
    assert 0.2 < len(canonical.views) / len(FOUND.views) < 0.8


def test_the_points_of_each_frame_are_subsampled(monkeypatch):
    monkeypatch.setattr(motion_fit, "MAX_POINTS_PER_VIEW", 10)
    sizes = []
    distance = motion_fit._distance
    monkeypatch.setattr(motion_fit, "_distance", lambda a, b: sizes.append((len(a), len(b))) or distance(a, b))
    canonical = fit(FOUND, new_deformation(), 5)
    assert set(sizes) == {(10, 10)}
    assert len(canonical.views) > 10 * NUM_VIEWS


def test_a_deformation_without_parameters_stays_as_it_is():
    assert fit(FOUND, torch.nn.Identity()) is FOUND


def test_a_fit_that_is_stopped_leaves_the_deformation_as_it_was():
    deformation, steps = new_deformation(), []
    stopped = fit_motion(
        deformation, FOUND, TIMES, EXTENT, 300, generator(), lambda: steps.append(0) or len(steps) == 7
    )
    assert stopped is None
    assert len(steps) == 7
    for ours, new in zip(deformation.parameters(), new_deformation().parameters(), strict=True):
        assert torch.equal(ours, new)


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
