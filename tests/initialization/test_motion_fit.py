"""A deformation that is fitted to dynamic points before training."""

import dataclasses

import pytest
import torch

from tests import plain
from tests.scenes import error, generator, relative_error
from warpgs.initialization import motion_fit
from warpgs.initialization.dynamic_points import DynamicPoints, to_canonical
from warpgs.initialization.motion_fit import MAX_ERROR, Observed, fit_motion, never
from warpgs.model.fields import make_deformation
from warpgs.model.trunk import Trunk

NUM_VIEWS, NUM_POINTS = 21, 40
"""Frames, and points on each of two objects in a frame."""
VIEW_SIZE = 4.0
TIMES = torch.linspace(0, 1, NUM_VIEWS)
COLORS = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
"""Colours of the two objects."""
MODEL = plain.model(position_bands=4, time_bands=4, depth=3, width=64, skip=2, half=False)


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
UNEVEN = FOUND.chosen((torch.arange(len(FOUND.views)) % NUM_POINTS < 6) | (FOUND.views % 4 == 2))
"""Most frames show 6 of the points on each object."""


def new_deformation(device="cpu", **model):
    torch.manual_seed(0)
    box = torch.zeros(3, device=device), torch.ones(3, device=device)
    return make_deformation(dataclasses.replace(MODEL, **model), *box)


def fit(found, deformation, num_steps=300, is_stopped=never, graph=True):
    schedule = dataclasses.replace(plain.config().schedule, fit_motion=num_steps)
    config = dataclasses.replace(plain.config(), schedule=schedule, graph=graph)
    fitted = fit_motion(deformation, Observed(found, TIMES, VIEW_SIZE), config, generator(), is_stopped)
    return None if fitted is None else fitted.points


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
        assert torch.cdist(deformed(deformation, canonical, view), seen).amin(1).max() <= MAX_ERROR * VIEW_SIZE


def test_each_object_is_one_cluster_in_canonical_space(fitted):
    canonical, _ = fitted
    first, second = (canonical.positions[(canonical.colors == color).all(1)] for color in COLORS)
    spread = max((points - points.mean(0)).norm(dim=1).max() for points in (first, second))
    assert spread < 0.15
    assert (first.mean(0) - second.mean(0)).norm() > 0.5


def max_error(canonical, deformation):
    """Maximum distance between the means of the deformed points of an object and where the object is."""
    errors = []
    for color, label in zip(COLORS, (0, 1), strict=True):
        points = canonical.positions[(canonical.colors == color).all(1)].to(next(deformation.parameters()).device)
        for time in TIMES:
            with torch.no_grad():
                moved = points + deformation(points, time[None].to(points.device))[:, :3]
            errors.append(error(moved.mean(0).cpu(), centers(time)[label]))
    return max(errors)


def test_an_object_is_carried_along_its_own_way(fitted):
    assert max_error(*fitted) < 0.1  # the objects are 0.6 apart


def pick_with_repetitions(points, index):
    """Stands in for ``_PointsByView.pick``, which does so on CUDA."""
    return points.times[index][0], points.seen[index][0], points.counts[index][0]


@pytest.mark.parametrize("repeats", [False, True])
def test_objects_are_followed_through_frames_with_few_points(monkeypatch, repeats):
    if repeats:
        monkeypatch.setattr(motion_fit._PointsByView, "pick", pick_with_repetitions)
    deformation = new_deformation()
    canonical = fit(UNEVEN, deformation)
    assert len(canonical.views) > 0.8 * len(UNEVEN.views)
    assert max_error(canonical, deformation) < 0.15  # the objects are 0.6 apart


def test_repetitions_change_neither_the_distance_of_a_view_nor_its_gradient():
    points = motion_fit._PointsByView(UNEVEN, TIMES, VIEW_SIZE, torch.device("cpu"), generator())
    assert points.counts.unique().tolist() == [12, 2 * NUM_POINTS]
    deformed = (points.home + 0.3 * torch.randn(points.home.shape, generator=generator())).requires_grad_()
    for index, view in enumerate(points.views):
        time, seen, count = points.pick(torch.tensor([index]))
        assert torch.equal(time, TIMES[view : view + 1])
        assert torch.equal(seen, points._features(UNEVEN.chosen(UNEVEN.views == view)))
        alone, repeated = (motion_fit._distance(deformed, some, count) for some in (seen, points.seen[index]))
        assert relative_error(repeated, alone) < 1e-6
        assert relative_error(*(torch.autograd.grad(x, deformed)[0] for x in (repeated, alone))) < 1e-5


def test_the_distance_is_the_mean_over_all_points_of_that_to_the_nearest_one():
    deformed, seen = (torch.randn(num, 6, generator=generator(num)) for num in (50, 30))
    squared = torch.cdist(deformed.double(), seen.double()).square()
    found, hidden = (9.0 * (1.0 + nearest / 9.0).log() for nearest in (squared.amin(0), squared.amin(1)))
    expected = found.mean() + motion_fit.HIDDEN_WEIGHT * hidden.mean()
    for repetitions in (0, 1, 30, 47):
        repeated = torch.cat([seen, seen, seen])[: 30 + repetitions]
        assert relative_error(motion_fit._distance(deformed, repeated, torch.tensor(30)), expected) < 1e-5


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
        assert torch.cdist(deformed(deformation, grey, view), seen).amin(1).max() <= MAX_ERROR * VIEW_SIZE


@pytest.mark.parametrize("distance", [3.0, 10.0, 30.0, 100.0])
def test_a_point_is_pulled_towards_an_object_however_far_it_is(distance):
    deformed = torch.tensor([[distance, 0.0, 0.0, 0.0, 0.0, 0.0]]).requires_grad_()
    motion_fit._distance(deformed, torch.zeros(1, 6), torch.tensor(1)).backward()
    assert deformed.grad[0, 0] * distance > 10.0  # a robust distance that has a limit ends at 0


class Collapsed(torch.nn.Module):
    """It moves everything to one place."""

    def __init__(self):
        super().__init__()
        self.place = torch.nn.Parameter(torch.zeros(3))

    def forward(self, means, time):
        return torch.cat([self.place - means, means.new_zeros(len(means), 7)], 1)


def test_a_fit_that_explains_few_points_is_not_used():
    deformation = Collapsed()
    assert fit(FOUND, deformation, 20) is FOUND
    assert torch.equal(deformation.place, torch.zeros(3))


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
    monkeypatch.setattr(
        motion_fit, "_distance", lambda a, b, c: sizes.append((len(a), len(b), int(c))) or distance(a, b, c)
    )
    canonical = fit(FOUND, new_deformation(), 5)
    assert set(sizes) == {(10, 10, 10)}
    assert len(canonical.views) > 10 * NUM_VIEWS


def test_a_fit_that_is_stopped_leaves_the_deformation_as_it_was():
    deformation, steps = new_deformation(), []
    assert fit(FOUND, deformation, is_stopped=lambda done: steps.append(done) or len(steps) == 7) is None
    assert steps == pytest.approx([k / 300 for k in range(1, 8)])
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


class Turned(torch.nn.Module):
    """Turns about the z axis by ``time`` half turns, as objects that tumble."""

    def forward(self, points, time):
        angle = torch.pi * time[0]
        turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
        return torch.nn.functional.pad(points[:, :2] @ turn.T - points[:, :2], (0, 8))


@pytest.mark.parametrize("time", [0.3, 0.8])
def test_a_deformation_that_turns_is_inverted(time):
    time, start = torch.tensor([time]), torch.rand(20, 3, generator=generator())
    seen = start + Turned()(start, time)[:, :3]
    found, reached = to_canonical(Turned(), seen, time, start + 0.1, 1e-3)
    assert reached.all()
    assert error(found, start) < 1e-3


def test_points_that_are_there_stay():
    deformation, time = Turned(), torch.tensor([0.5])
    start = torch.rand(5, 3, generator=generator())
    seen = start + deformation(start, time)[:, :3]
    found, reached = to_canonical(deformation, seen, time, start + torch.tensor([0.0, 0, 0, 0.2, 0.2])[:, None], 1e-3)
    assert reached.all()
    assert torch.equal(found[:3], start[:3])


def test_points_that_cannot_be_reached_are_said_not_to_be():
    class Flat(torch.nn.Module):
        def forward(self, points, time):
            return torch.nn.functional.pad(-points, (0, 7))

    _, reached = to_canonical(Flat(), torch.ones(3, 3), torch.zeros(1), torch.zeros(3, 3), 1e-3)
    assert not reached.any()
    assert to_canonical(Flat(), torch.ones(0, 3), torch.zeros(1), torch.zeros(0, 3), 1e-3)[0].shape == (0, 3)


def test_sides_that_no_canonical_point_shows_are_found_where_an_object_turns():
    """Each frame shows the half of a sphere that faces the camera, and the sphere makes a turn."""
    sphere = torch.nn.functional.normalize(torch.randn(NUM_VIEWS * 200, 3, generator=generator()), dim=1) * 0.15
    views = torch.arange(NUM_VIEWS).repeat_interleave(200)
    turns = [Turned()(sphere[views == view], 2.0 * TIMES[view : view + 1])[:, :3] for view in range(NUM_VIEWS)]
    positions = sphere + torch.cat(turns)
    facing = positions[:, 1] < 0.0
    found = DynamicPoints(positions, torch.full_like(positions, 0.5), views, True).chosen(facing)
    points = motion_fit._PointsByView(found, TIMES, VIEW_SIZE, torch.device("cpu"), generator())

    class Known(Turned):
        def forward(self, points, time):
            return super().forward(points, 2.0 * time)

    start = motion_fit._start_time(TIMES, torch.bincount(found.views))
    home = Known()(points.home[:, :3] * points.unit, torch.tensor([-start]))[:, :3]
    points.home[:, :3] += home / points.unit
    canonical = points.canonical(Known(), found)
    assert len(canonical.views) > 0.95 * len(found.views)
    behind = sphere[facing][:, 1] > 0.1
    assert len(canonical.views[canonical.positions[:, 1] > 0.1]) > 0.9 * int(behind.sum())


@pytest.mark.parametrize(("shift", "kept"), [(0.0, [0, 1, 2]), (0.5, [2])])
def test_where_positions_are_searched_and_how_far_from_the_canonical_point(monkeypatch, shift, kept):
    """By half a turn: a point where the canonical point is, one beside it, and one that no canonical point shows."""
    colors = COLORS[[0, 0, 1]]
    seen = torch.tensor([[-0.5, 0.0, 0.0], [-0.5, -0.1, 0.0], [0.2, 0.3, 0.0]])
    found = DynamicPoints(seen, colors, torch.full((3,), NUM_VIEWS - 1), True)
    points = motion_fit._PointsByView(found, TIMES, VIEW_SIZE, torch.device("cpu"), generator())
    home = torch.tensor([[0.5, 0.0, 0.0]])
    points.home = points._features(found.chosen(torch.tensor([0]))._replace(positions=home))

    def search(deformation, goal, time, start, max_error):
        assert error(start, torch.stack([home[0], home[0], home[0] + seen[2] - seen[0]])) < 1e-6
        return start + shift, torch.ones(3, dtype=torch.bool)

    monkeypatch.setattr(motion_fit, "to_canonical", search)
    canonical = points.canonical(Turned(), found)
    assert error(canonical.colors, colors[kept]) == 0.0


def test_the_fit_is_in_single_precision_and_leaves_the_deformation_in_its_own(monkeypatch):
    seen, forward = [], Trunk.forward
    monkeypatch.setattr(
        Trunk, "forward", lambda self, *inputs: (seen.append(self.uses_half), forward(self, *inputs))[1]
    )
    deformation = new_deformation(half=True)
    assert deformation.trunk.uses_half
    assert fit(FOUND, deformation, num_steps=3) is not None
    assert set(seen) == {False}
    assert deformation.trunk.uses_half
