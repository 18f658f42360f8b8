"""The door of density control: what strategies may rely on."""

import dataclasses
from typing import ClassVar
from unittest.mock import Mock

import pytest
import torch

from tests import tiny
from warpgs.config import DensifyConfig, RenderSettings
from warpgs.training.density import DENSITY, make_strategy
from warpgs.training.density.strategy import Strategy
from warpgs.training.logger import TrainingLogger


class Recorder(Strategy):
    """Counts the views of every Gaussian, and records what it is asked to do."""

    calls: ClassVar[list[str]] = []

    def __init__(self, config):
        super().__init__(config)
        self.calls.clear()
        self.actions = {name: lambda at, name=name: self.calls.append(name) for name in self.actions}

    def begin(self, num, device):
        self.views = torch.zeros(num, device=device)

    def settings(self, settings):
        return dataclasses.replace(settings, max_alpha=0.5)

    def observe(self, splats, camera, radii):
        assert splats.means.shape[0] == radii.shape[0] == len(self.views)
        self.views += radii[:, 0] > 0

    def state(self):
        return {"views": self.views}

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
        make_strategy(DensifyConfig(strategy="3dgz"))


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


def test_a_strategy_changes_how_training_steps_are_rendered(trainer):
    settings = trainer.step._settings(trainer.protocol.phase_at(0))
    assert settings == RenderSettings(branches=True, depth=True, antialias=False, max_alpha=0.5)


def test_the_state_of_a_strategy_is_resumed(trainer, data):
    step(trainer)
    trainer.save()
    resumed = tiny.trainer(data, trainer.run, trainer.config)
    assert not resumed.step.density.views.any()
    resumed.restore_newest(print)
    assert torch.equal(resumed.step.density.views, trainer.step.density.views)
    assert resumed.step.density.views.any()
