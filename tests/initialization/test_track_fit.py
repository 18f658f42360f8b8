"""Tracks of a network in the fit of the deformation: a ring of one colour, whose turning nothing else tells."""

import dataclasses
import math
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from tests import plain, tiny
from tests.scenes import generator
from warpgs.captures.opening import load_capture
from warpgs.data.tracks import Tracks, write_tracks
from warpgs.initialization import track_paths
from warpgs.initialization.dynamic_points import DynamicPoints
from warpgs.initialization.motion_fit import MAX_ERROR, Observed, fit_motion
from warpgs.initialization.track_paths import Paths, dynamic_paths
from warpgs.model.fields import make_deformation
from warpgs.runs.logger import TrainingLogger
from warpgs.synthetic.studio import StudioSize, studio_capture
from warpgs.synthetic.studio_tracks import exact_tracks
from warpgs.views.views import Views

NUM_VIEWS, NUM_POINTS = 15, 60
VIEW_SIZE = 4.0
TIMES = torch.linspace(0, 1, NUM_VIEWS)
CAMERA = torch.tensor([0.0, 0.0, -4.0])
TURN = math.pi
"""By which the ring turns around the axis of the camera over the capture [rad]."""


def ring(time):
    """[P, 3] the points at a time."""
    angle = 2.0 * math.pi * torch.arange(NUM_POINTS) / NUM_POINTS + TURN * time
    return 0.4 * torch.stack([angle.cos(), angle.sin(), 0.0 * angle], 1)


RING = torch.stack([ring(time) for time in TIMES], 1)
"""[P, V, 3] the points in all views."""


def observed(points=RING, with_depth=True, count=NUM_POINTS):
    """What views see of the ring, and tracks at ``points`` [N, V, 3], of which the first ``count`` are given."""
    colors = torch.full((NUM_POINTS * NUM_VIEWS, 3), 0.5)
    views = torch.arange(NUM_VIEWS).repeat_interleave(NUM_POINTS)
    found = DynamicPoints(RING.transpose(0, 1).reshape(-1, 3), colors, views, True)
    rays = torch.nn.functional.normalize(points - CAMERA, dim=2)
    known = points if with_depth else torch.full_like(points, torch.nan)
    paths = Paths(CAMERA.expand(NUM_VIEWS, 3), rays, known, torch.full((NUM_POINTS, 3), 0.5))
    return Observed(found, TIMES, VIEW_SIZE, paths.chosen(torch.arange(count)))


def new_deformation():
    torch.manual_seed(0)
    model = plain.model(position_bands=4, time_bands=4, depth=3, width=64, skip=2, half=False)
    return make_deformation(model, torch.zeros(3), torch.ones(3))


def config_of(num_steps, graph=True):
    schedule = dataclasses.replace(plain.config().schedule, fit_motion=num_steps)
    return dataclasses.replace(plain.config(), schedule=schedule, graph=graph)


def fit(seen):
    """The fit, and how far the deformation takes the points of the first frame from where they are in the others."""
    deformation = new_deformation()
    result = fit_motion(deformation, seen, config_of(250), generator())
    with torch.no_grad():
        first = result.points.chosen(result.points.views == 0)
        index = torch.cdist(first.positions + deformation(first.positions, TIMES[:1])[:, :3], RING[:, 0]).argmin(1)
        moved = [first.positions + deformation(first.positions, time[None])[:, :3] for time in TIMES]
    return result, (torch.stack(moved, 1) - RING[index]).norm(dim=2).median().item()


@pytest.fixture(scope="module")
def with_tracks():
    return fit(observed())


def test_with_tracks_points_turn_with_the_ring(with_tracks):
    result, error = with_tracks
    assert error < MAX_ERROR * VIEW_SIZE
    assert result.num_tracks > 0.9 * NUM_POINTS
    assert len(result.points.views) > 0.9 * NUM_POINTS * NUM_VIEWS


def test_without_tracks_nothing_tells_that_the_ring_turns():
    result, error = fit(observed()._replace(paths=None))
    assert result.num_tracks == 0
    assert error > 3.0 * MAX_ERROR * VIEW_SIZE


def test_tracks_that_jump_to_other_points_are_not_followed():
    points = RING.clone()
    points[::3, NUM_VIEWS // 2 :] = RING[::3, NUM_VIEWS // 2 :].roll(7, 0)
    result, error = fit(observed(points))
    assert error < MAX_ERROR * VIEW_SIZE
    assert 0.5 * NUM_POINTS < result.num_tracks < 0.9 * NUM_POINTS


def test_tracks_that_fit_nothing_are_not_used():
    noise = 0.5 * torch.randn(RING.shape, generator=generator(1)) * torch.tensor([1.0, 1.0, 0.2])
    used, unused = fit(observed(noise)), fit(observed()._replace(paths=None))
    assert used[0].num_tracks == 0
    assert used[1] == pytest.approx(unused[1], rel=0.5)


@pytest.mark.parametrize(("with_depth", "count"), [(False, NUM_POINTS), (True, 0)], ids=["no depth", "no tracks"])
def test_without_tracks_of_known_depth_the_fit_is_as_without_any(with_depth, count):
    result, _ = fit(observed(with_depth=with_depth, count=count))
    expected, _ = fit(observed()._replace(paths=None))
    assert result.num_tracks == 0
    assert torch.equal(result.points.positions, expected.points.positions)


def test_a_fit_stops_while_it_follows_tracks():
    deformation, stops = new_deformation(), iter([False, False, True])
    before = [parameter.clone() for parameter in deformation.parameters()]
    assert fit_motion(deformation, observed(), config_of(50), generator(), lambda done: next(stops)) is None
    assert all(torch.equal(*pair) for pair in zip(before, deformation.parameters(), strict=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_replayed_fit_to_tracks_is_as_good_as_an_eager_one():
    for graph in (True, False):
        deformation = new_deformation().to("cuda")
        result = fit_motion(deformation, observed(), config_of(250, graph), generator())
        assert result.num_tracks > 0.9 * NUM_POINTS


def test_a_training_says_how_many_tracks_its_deformation_follows(tmp_path):
    root = tiny.write(tmp_path / "capture")
    visible = np.ones((5, tiny.SCENE.num_frames), bool)
    write_tracks(root, np.full((*visible.shape, 2), 1.0), visible, (32, 24))
    trainer, logger = tiny.trainer(root, tmp_path / "run"), MagicMock(spec=TrainingLogger)
    trainer._add_dynamic_gaussians(logger=logger)
    logger.log.assert_called_with("the deformation follows 0 of 5 tracks")


SIZE = StudioSize(width=96, height=54, num_frames=8, num_samples=1, num_points=500)


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    return load_capture(studio_capture("exact", tmp_path_factory.mktemp("studio"), SIZE, quiet=True))


@pytest.fixture(scope="module")
def tracks(studio):
    positions, visible = exact_tracks(SIZE)
    relative = np.where(visible[..., None], positions / (SIZE.width, SIZE.height), np.nan)
    return Tracks(tuple(studio.film), relative.astype(np.float32))


def paths_of(studio, tracks):
    views = Views(studio, torch.device("cpu"), 1 << 30)
    alignments = torch.tensor([[1.0, 0.0]]).repeat(len(studio.train), 1)
    return dynamic_paths(tracks, list(studio.train), views, alignments), views


def test_paths_are_of_tracks_that_stay_on_what_moves(studio, tracks):
    paths, views = paths_of(studio, tracks)
    assert 0 < len(paths.rays) < len(tracks.positions)
    for k, view in enumerate(views):
        seen = paths.rays[:, k, 0].isfinite()
        row, column, _, inside = view.camera.project(paths.origins[k] + paths.rays[seen, k])
        assert inside.all()
        assert not view.static_mask[row, column].any()
    assert (paths.rays[..., 0].isfinite().sum(1) >= track_paths.MIN_SEEN).all()


def test_points_of_paths_are_on_their_rays_at_the_depth_of_the_view(studio, tracks):
    paths, views = paths_of(studio, tracks)
    for k, view in enumerate(views):
        seen = paths.rays[:, k, 0].isfinite()
        points = paths.points[seen, k]
        torch.testing.assert_close(torch.nn.functional.normalize(points - paths.origins[k], dim=1), paths.rays[seen, k])
        row, column, depth, _ = view.camera.project(points)
        torch.testing.assert_close(depth, 1.0 / view.inverse_depth[row, column], rtol=1e-4, atol=0.0)


def test_tracks_that_are_mostly_on_static_surfaces_are_omitted(studio):
    """A track of eight frames on what moves, then the same with a static pixel in four and in five of them."""
    masks = [studio.frame(name).static_mask.numpy() for name in studio.film]
    dynamic = np.array([np.argwhere(~mask)[0][::-1] + 0.5 for mask in masks]) / (SIZE.width, SIZE.height)
    positions = np.tile(dynamic.astype(np.float32), (3, 1, 1))
    positions[1, :4] = positions[2, :5] = 0.001
    paths, _ = paths_of(studio, Tracks(tuple(studio.film), positions))
    assert paths.rays[..., 0].isfinite().sum(1).tolist() == [8, 4]


def test_paths_have_a_maximum_number(studio, tracks, monkeypatch):
    monkeypatch.setattr(track_paths, "MAX_PATHS", 10)
    assert len(paths_of(studio, tracks)[0].rays) == 10


def test_held_out_frames_of_the_camera_are_not_looked_at(studio, tracks):
    split = studio.split([name for name in studio.film if name != studio.film[3]], [studio.film[3]])
    paths, _ = paths_of(split, tracks)
    assert paths.rays.shape[1] == len(studio.film) - 1
