"""Tracks of small objects that move far between frames, and trainings that start on them."""

import dataclasses

import numpy as np
import pytest
import torch

from tests import plain, tiny
from warpgs.cameras import Camera
from warpgs.captures.opening import load_capture
from warpgs.config import RenderSettings
from warpgs.config.presets import PRESETS
from warpgs.data.capture import Capture, Frame
from warpgs.initialization import tracks as module
from warpgs.initialization.prepare_start import prepare_again, prepare_start
from warpgs.initialization.silhouettes import Region
from warpgs.initialization.tracked_start import MAX_FINAL_RATE, MAX_RATE
from warpgs.initialization.tracks import _divided
from warpgs.model.spline_deformation import SplineDeformation
from warpgs.rendering import render
from warpgs.synthetic.balls import RADIUS, BallsSize, _balls, balls_capture
from warpgs.training.optimizer import FIXED_RATES
from warpgs.views.views import Views

SIZE = BallsSize(side=100, num_frames=50, num_val=6, turns=4.0)
UNITS = 1.3
"""World units of D-NeRF per scene unit."""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return balls_capture(tmp_path_factory.mktemp("cache"), SIZE, quiet=True)


@pytest.fixture(scope="module")
def capture(data):
    return load_capture(data)


@pytest.fixture(scope="module")
def tracks(capture):
    return find_tracks(capture)


def find_tracks(capture):
    return module.find_tracks(capture, Views(capture, torch.device("cpu"), 1 << 30))


def ball_centers(times: np.ndarray) -> np.ndarray:
    """[T, 5, 3] scene units."""
    return np.array([[body.center for body in _balls(time, SIZE)] for time in times]) / UNITS


def test_a_region_of_two_objects_is_divided_by_their_colours():
    random = np.random.default_rng(0)
    rays = np.stack([np.linspace(-0.1, 0.1, 200), np.zeros(200), np.ones(200)], 1)
    red, blue = (
        np.array(color) + 0.05 * random.standard_normal((200, 3)) for color in ([0.9, 0.1, 0.1], [0.1, 0.1, 0.9])
    )

    def region(colors: np.ndarray, chosen: slice) -> Region:
        lab = 255.0 * colors[chosen].mean(0)
        whole = Region(0.5, np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.05, lab, rays, colors)
        return whole.part(np.isin(np.arange(200), np.arange(200)[chosen]))

    alone = [region(colors, slice(None)) for colors in (red, blue) for _ in range(6)]
    both = region(np.where(np.arange(200)[:, None] < 150, red, blue), slice(None))
    labels = np.array([0] * 6 + [1] * 6 + [0])
    found, of_found = _divided([*alone, both], labels, 2)
    assert of_found.tolist() == [*labels[:12], 0, 1]
    assert all(a is b for a, b in zip(found, alone, strict=False))
    assert found[12].center[0] == pytest.approx(-0.025, abs=2e-3)
    assert found[13].center[0] == pytest.approx(0.075, abs=2e-3)
    assert [part.radius for part in found[12:]] == pytest.approx([0.05 * 0.75**0.5, 0.05 * 0.25**0.5], rel=0.02)


@pytest.mark.parametrize("halfway", [False, True])
def test_every_ball_has_a_track(tracks, halfway):
    times = (np.arange(1, 48) + 0.5 * halfway) / 49
    centers = ball_centers(times)
    errors = np.array([np.linalg.norm(t.path(times)[:, None] - centers, axis=2) for t in tracks])
    medians = np.median(errors, axis=1)
    assert sorted(medians.argmin(1)) == [0, 1, 2, 3, 4]
    assert medians.min(1).max() < 0.2 * RADIUS / UNITS
    assert np.quantile(errors.min(2), 0.98) < RADIUS / UNITS  # also where one hides another
    assert [t.radius for t in tracks] == pytest.approx([RADIUS / UNITS] * 5, rel=0.25)  # with the rim that is mixed


def test_what_moves_little_from_frame_to_frame_is_not_tracked(tmp_path):
    slow = balls_capture(tmp_path, BallsSize(side=80, num_frames=60, num_val=2, turns=0.5), quiet=True)
    assert find_tracks(load_capture(slow)) == []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MIN_STEP", 0.0)
        assert len(find_tracks(load_capture(slow))) == 5


def ball_on_white(centers: list[np.ndarray]) -> Capture:
    """A ball of radius 0.1 that hardly moves, before white, seen from these points by cameras that face the origin."""
    side, focal, num = 120, 150.0, len(centers)
    K = torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    cameras, empty = {}, {}
    for k, center in enumerate(centers):
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.from_numpy(np.stack([right, np.cross(forward, right), forward]))
        viewmat[:3, 3] = -viewmat[:3, :3] @ torch.from_numpy(center).float()
        cameras[str(k)] = Camera(viewmat, K, side, side, k / (num - 1))
        ball = np.array([0.4, 0.0, 0.1 * np.sin(4.0 * k / (num - 1))])
        u, v, depth = viewmat[:3, :3].numpy() @ ball + viewmat[:3, 3].numpy()
        y, x = np.mgrid[:side, :side] + 0.5 - side / 2
        empty[str(k)] = torch.from_numpy(np.hypot(x - focal * u / depth, y - focal * v / depth) > focal * 0.1 / depth)

    def read(name: str) -> Frame:
        image = torch.full((side, side, 3), 255, dtype=torch.uint8)
        image[~empty[name]] = torch.tensor([200, 60, 20], dtype=torch.uint8)
        return Frame(name, cameras[name], image, empty=empty[name])

    points = torch.zeros(0, 3)
    names = list(cameras)
    return Capture("ball", cameras, names, [], points, None, read, unmasked="dynamic", background="white")


@pytest.mark.parametrize("turns", [0.0, 0.25, 2.0])
def test_nothing_is_tracked_by_a_camera_that_moves_evenly(turns):
    """Its own path meets all of its rays."""
    angles = 2.0 * np.pi * turns * np.linspace(0.0, 1.0, 60)
    capture = ball_on_white([np.array([3.0 * np.cos(a), 3.0 * np.sin(a), 1.0]) for a in angles])
    assert find_tracks(capture) == []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MIN_BEND", -1.0)
        assert bool(find_tracks(capture)) == (turns > 0)


def test_what_two_still_cameras_see_is_tracked_with_as_many_knots_as_either_has_times():
    capture = ball_on_white([np.array([3.0, 0.0, 1.0]), np.array([0.0, 3.0, 1.0])] * 30)
    assert find_tracks(capture) == []  # as the places of one camera, that goes back and forth
    cameras = {name: dataclasses.replace(c, id=int(name) % 2) for name, c in capture.cameras.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MIN_STEP", 0.0)
        (track,) = find_tracks(capture.with_cameras(cameras))
    assert len(track.path.t) == 31 + 2 * module.DEGREE  # 30 times of one camera, and one of the other at the end
    assert np.linalg.norm(track.path(0.5) - [0.4, 0.0, 0.1 * np.sin(2.0)]) < 0.03


def test_the_penalty_is_that_of_fifth_differences():
    points = np.random.default_rng(0).standard_normal((12, 3))
    bands = module._difference_penalty(12)
    matrix = sum(np.diag(band[: 36 - k], -k) for k, band in enumerate(bands))
    matrix = matrix + np.tril(matrix, -1).T
    assert points.ravel() @ matrix @ points.ravel() == pytest.approx((np.diff(points, 5, axis=0) ** 2).sum())


def test_many_specks_are_not_tracked(capture, monkeypatch):
    monkeypatch.setattr(module, "MAX_OBJECTS", 4)
    assert find_tracks(capture) == []


def test_nothing_is_tracked_without_transparent_surroundings_or_with_masks(capture, tmp_path):
    assert find_tracks(capture.over("black")) == []
    assert find_tracks(capture.assuming("static")) == []
    assert find_tracks(load_capture(tiny.write(tmp_path))) == []


def test_too_few_frames_are_not_tracked(tmp_path):
    short = balls_capture(tmp_path, BallsSize(side=64, num_frames=6, num_val=2, turns=0.5), quiet=True)
    assert find_tracks(load_capture(short)) == []


@pytest.mark.parametrize("preset", ["best", "quick"])
def test_the_config_follows_tracks_from_the_start(capture, preset):
    start = prepare_start(dataclasses.replace(PRESETS[preset], device="cpu"), capture)
    found = start.plan
    assert found.model.deformation == "splines"
    assert (found.schedule.deform_from, found.schedule.noise_until) == (0, 0)
    assert found.optim.networks == MAX_RATE
    assert found.optim.networks_end == min(MAX_FINAL_RATE, PRESETS[preset].optim.networks_end)
    assert "dynamic Gaussians start on the tracks of 5 objects, which move far from frame to frame" in start.notes
    assert isinstance(start.scene.deformation, SplineDeformation)


def test_the_paper_starts_without_tracks(capture):
    assert prepare_start(dataclasses.replace(PRESETS["paper"], device="cpu"), capture).plan.model.deformation == "mlp"


def test_a_run_that_was_begun_without_tracks_goes_on_without_them(capture):
    assert prepare_again(plain.plan(PRESETS["quick"]), capture).plan.model.deformation == "mlp"


def test_tracks_can_be_switched_off(capture):
    model = dataclasses.replace(PRESETS["quick"].model, tracks=False)
    config = dataclasses.replace(PRESETS["quick"], device="cpu", model=model)
    assert prepare_start(config, capture).plan.model.deformation == "mlp"
    with pytest.raises(ValueError, match="splines"):
        prepare_start(dataclasses.replace(config, model=dataclasses.replace(model, deformation="splines")), capture)


def test_splines_are_refused_where_nothing_is_tracked(tmp_path):
    config = plain.config(model=dataclasses.replace(plain.config().model, deformation="splines"))
    with pytest.raises(ValueError, match="no small objects are tracked"):
        prepare_start(config, load_capture(tiny.write(tmp_path)))


@pytest.fixture
def trainer(data, capture, tmp_path, monkeypatch):
    model = dataclasses.replace(tiny.MODEL, dynamic_points=500)
    schedule = plain.schedule(pretrain=0, stage1=20, stage2=10, densify_until=0, reset_every=1_000, prune_every=1_000)
    monkeypatch.setitem(FIXED_RATES, "logit_opacities", 0.3)
    config = dataclasses.replace(tiny.CONFIG, background="capture", model=model, schedule=schedule)
    return tiny.trainer(data, tmp_path / "run", config)


def test_dynamic_gaussians_start_on_the_balls_at_all_times(trainer):
    trainer._add_dynamic_gaussians()
    means = trainer.scene.dynamic.means.detach()
    distances = []
    for time in np.arange(1, 48) / 49:
        moved = means + trainer.scene.deformation(means, torch.tensor([time]).float())[:, :3].detach()
        centers = torch.from_numpy(ball_centers(np.array([time]))[0]).float()
        distances.append(torch.cdist(moved, centers).amin(1))
    assert torch.cat(distances).quantile(0.8) < 1.5 * RADIUS / UNITS


def test_a_checkpoint_brings_the_paths_of_its_tracks(trainer, data, tmp_path):
    trainer._add_dynamic_gaussians()
    trainer.save()
    other = tiny.trainer(data, tmp_path / "run", trainer.config)
    assert other.scene.deformation.paths.shape != trainer.scene.deformation.paths.shape
    other.restore_newest(print)
    assert torch.equal(other.scene.deformation.paths, trainer.scene.deformation.paths)
    assert torch.equal(other.scene.deformation.homes, trainer.scene.deformation.homes)


def test_the_balls_are_still_there_after_training(trainer, capture, quickly):
    assert tiny.train(trainer)
    alphas = []
    for name in capture.val:
        frame = capture.frame(name)
        splats = trainer.scene.splats(torch.tensor([frame.camera.time]))
        image = render(splats, frame.camera, settings=RenderSettings(branches=True)).dynamic
        alphas.append(image.alpha[~frame.static_mask].mean().item())
    assert np.median(alphas) > 0.5
