"""The door of density control: what strategies may rely on."""

import dataclasses
from typing import ClassVar
from unittest.mock import Mock

import pytest
import torch

from tests import plain, tiny
from tests.scenes import relative_error
from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.runs import checkpoint
from warpgs.runs.logger import TrainingLogger
from warpgs.training.density import DENSITY, make_strategy
from warpgs.training.density.strategy import Strategy


class Recorder(Strategy):
    """Counts the views of every Gaussian, and records what it is asked to do."""

    calls: ClassVar[list[str]] = []

    def __init__(self, config):
        super().__init__(config)
        self.calls.clear()
        self.actions = {name: lambda at, name=name: self.calls.append(name) for name in self.actions}

    def begin(self, num, device):
        super().begin(num, device)
        self.views = torch.zeros(num, device=device)

    def settings(self, settings):
        return dataclasses.replace(settings, max_alpha=0.5)

    def observe(self, splats, camera, radii):
        super().observe(splats, camera, radii)
        assert splats.means.shape[0] == radii.shape[0] == len(self.views)
        self.views += radii[:, 0] > 0

    def state(self):
        return super().state() | {"views": self.views}

    def densify(self, at):
        raise AssertionError


@pytest.fixture
def trainer(data, tmp_path, monkeypatch):
    monkeypatch.setitem(DENSITY, "recorder", Recorder)
    densify = dataclasses.replace(tiny.CONFIG.densify, strategy="recorder", reseed=0.05)
    return tiny.trainer(data, tmp_path / "run", dataclasses.replace(tiny.CONFIG, densify=densify))


def step(trainer):
    plan = trainer.protocol.at(trainer.iteration)
    trainer.step(plan, trainer._sample(plan))


def test_an_unknown_strategy_is_refused_by_name():
    message = r"no density strategy '3dgz'; densify\.strategy is one of: 3dgs.*; did you mean 3dgs\?$"
    with pytest.raises(ValueError, match=message):
        make_strategy(plain.densify(strategy="3dgz"))


def test_a_strategy_is_asked_for_the_actions_of_the_schedule_in_their_order(trainer):
    with tiny.in_haste():
        tiny.train(trainer)
    planned = [action for k in range(tiny.LENGTH) for action in trainer.protocol.at(k).actions]
    assert {"densify", "reset", "prune", "prune_weakest"} < set(planned)
    assert Recorder.calls == [action for action in planned if action != "realign"]


def test_a_strategy_does_nothing_for_actions_that_it_does_not_have(trainer):
    density = trainer.step.density
    del density.actions["reset"]
    plan = dataclasses.replace(tiny.plan_to(trainer, "reset"), actions=("prune", "reset"))
    trainer._adapt(plan, Mock(spec=TrainingLogger))
    assert Recorder.calls == ["prune"]


def test_a_strategy_observes_every_view_and_starts_anew_after_gaussians_were_replaced(trainer):
    step(trainer)
    step(trainer)
    assert trainer.step.density.views.max() == 2
    trainer._adapt(tiny.plan_to(trainer, "reset"), Mock(spec=TrainingLogger))
    assert trainer.step.density.views.max() == 2
    trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    assert trainer.step.density.views.max() == 0


@pytest.mark.parametrize(("after", "max_alpha"), [(-1, 0.5), (0, RenderSettings.max_alpha)])
def test_a_strategy_changes_how_training_steps_are_rendered_until_the_last_densification(trainer, after, max_alpha):
    end = trainer.protocol.stage1.start + trainer.config.schedule.densify_until
    settings = trainer.step._settings(trainer.protocol.phase_at(end + after))
    assert settings == RenderSettings(branches=True, depth=True, antialias=False, max_alpha=max_alpha)


@pytest.mark.parametrize("strategy", ["3dgs", "absgrad"])
def test_gradients_on_screen_are_summed_until_the_last_densification(data, tmp_path, strategy):
    densify = dataclasses.replace(tiny.CONFIG.densify, strategy=strategy)
    trainer = tiny.trainer(data, tmp_path / "run", dataclasses.replace(tiny.CONFIG, densify=densify))
    counts = []
    end = trainer.protocol.stage1.start + trainer.config.schedule.densify_until
    for trainer.iteration in (end - 1, end):
        step(trainer)
        counts.append(trainer.step.density.count.clone())
    assert counts[0].any()
    assert torch.equal(*counts)


def test_the_state_of_a_strategy_is_resumed(trainer, data):
    step(trainer)
    trainer.save()
    resumed = tiny.trainer(data, trainer.run, trainer.config)
    assert not resumed.step.density.views.any()
    resumed.restore_newest(print)
    assert torch.equal(resumed.step.density.views, trainer.step.density.views)
    assert resumed.step.density.views.any()


@pytest.mark.parametrize("strategy", list(DENSITY))
def test_with_every_strategy_a_resumed_run_ends_with_the_same_bits(data, tmp_path, strategy):
    densify = dataclasses.replace(tiny.CONFIG.densify, strategy=strategy, max_elongation=3.0, reseed=0.05)
    optim = dataclasses.replace(tiny.CONFIG.optim, poses=1e-3)
    config = dataclasses.replace(tiny.CONFIG, densify=densify, optim=optim, antialias=True)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    with tiny.in_haste():
        assert tiny.train(tiny.trainer(data, whole, config))
        for stop in (8, 16, tiny.LENGTH):  # before the first densification, and between others
            trainer = tiny.trainer(data, parts, config)
            trainer.restore_newest(print)
            tiny.train(trainer, tiny.StopWhen(lambda trainer=trainer, stop=stop: trainer.iteration >= stop))
            assert trainer.iteration == stop
    assert tiny.differences(tiny.state(whole), tiny.state(parts)) == []


FOCAL = 50.0


def camera_at(z, focal=FOCAL, aspect=1.0):
    """A camera at a place of the z axis, on which it looks, whose pixels are wider than high by an aspect."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = -z
    return Camera(viewmat, torch.tensor([[focal, 0.0, 8.0], [0.0, focal * aspect, 6.0], [0.0, 0.0, 1.0]]), 16, 12)


def observed(views, depths=(2.0, 4.0, 8.0)):
    """A strategy that observed views, each of which shows the Gaussians of its indices at z = ``depths`` or its own."""
    strategy, num = Strategy(plain.densify()), len(depths)
    strategy.begin(num, torch.device("cpu"))
    for camera, shown, *moved in views:
        means = torch.zeros(num, 3)
        means[:, 2] = torch.tensor(moved[0] if moved else depths)
        splats = Splats(means, torch.ones(num, 4), torch.ones(num, 3), torch.ones(num), torch.ones(num, 3))
        radii = torch.zeros(num, 2, dtype=torch.int32)
        radii[shown] = 1
        strategy.observe(splats, camera, radii)
    return strategy


def test_the_resolution_of_a_gaussian_is_that_of_the_nearest_view_that_showed_it():
    strategy = observed([(camera_at(0.0), [0, 1]), (camera_at(1.0), [1]), (camera_at(-4.0), [0, 1])])
    assert strategy.resolution.tolist() == pytest.approx([FOCAL / 2.0, FOCAL / 3.0, 0.0])


def test_a_longer_lens_counts_like_a_nearer_camera():
    strategy = observed([(camera_at(0.0), [0]), (camera_at(0.0, 2.0 * FOCAL), [0])])
    assert strategy.resolution[0].item() == pytest.approx(2.0 * FOCAL / 2.0)


def test_pixels_that_are_not_square_count_by_the_mean_of_their_sides():
    strategy = observed([(camera_at(0.0, aspect=3.0), [0])])
    assert strategy.resolution[0].item() == pytest.approx(2.0 * FOCAL / 2.0)


def test_gaussians_that_are_deformed_have_the_depth_to_which_they_were():
    strategy = observed([(camera_at(0.0), [1]), (camera_at(0.0), [1], (2.0, 0.5, 8.0))])
    assert strategy.resolution[1].item() == pytest.approx(FOCAL / 0.5)


def test_culled_gaussians_behind_or_at_the_camera_leave_the_resolution_finite():
    strategy = observed([(camera_at(0.0), [2])], (0.0, -3.0, 8.0))
    assert strategy.resolution.tolist() == pytest.approx([0.0, 0.0, FOCAL / 8.0])


@pytest.mark.parametrize("unit", ["pixel", "extent"])
def test_sizes_are_measured_in_pixels_or_by_the_extent(trainer, unit):
    densify = dataclasses.replace(trainer.config.densify, unit=unit)
    trainer.config = dataclasses.replace(trainer.config, densify=densify)
    trainer.step.density.resolution = torch.tensor([50.0, 0.0])
    found = trainer.step.density.units(trainer._adaptation(trainer.protocol.at(0), Mock(spec=TrainingLogger)))
    extent = trainer.capture.extent
    assert found.tolist() == pytest.approx({"pixel": [0.02, torch.inf], "extent": [extent, extent]}[unit])


def test_dynamic_gaussians_are_observed_at_the_time_of_the_view(trainer):
    trainer._add_dynamic_gaussians()
    trainer.iteration = trainer.protocol.stage2.start
    for parameter in trainer.scene.deformation.parameters():
        parameter.data += 0.02 * torch.randn(parameter.shape)
    sample, num = trainer._sample(trainer.protocol.at(trainer.iteration)), len(trainer.scene.static)
    view = trainer.views[sample.view]
    with torch.no_grad():
        canonical = trainer.scene.dynamic.means.clone()
        means = trainer.scene.splats(view.time, time_noise=torch.tensor([sample.time_noise])).means[num:]
    step(trainer)
    found = trainer.step.density.resolution[num:]
    shown = found > 0
    expected, without = (view.camera.K[0, 0] / view.camera.project(x)[2][shown] for x in (means, canonical))
    assert shown.sum() > 5
    assert relative_error(found[shown], expected) < 1e-5 < relative_error(found[shown], without)


def test_a_checkpoint_of_version_0_3_is_resumed_as_if_no_view_had_shown_any_gaussian(trainer, data):
    step(trainer)
    trainer.save()
    path = checkpoint.list_checkpoints(trainer.run)[-1]
    saved = checkpoint.load(path)
    counts = saved.tensors["gradients.views"]
    tensors = saved.tensors | {"gradients.total": counts.clone(), "gradients.count": counts.clone()}
    checkpoint.save(path, {k: v for k, v in tensors.items() if k != "gradients.resolution"}, saved.metadata)
    resumed = tiny.trainer(data, trainer.run)
    resumed.restore_newest(print)
    assert trainer.step.density.resolution.any()
    assert not resumed.step.density.resolution.any()
    assert torch.equal(resumed.step.density.count, trainer.step.density.views)
