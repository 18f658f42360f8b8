"""Density control by Markov chain Monte Carlo."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch

from tests import tiny
from tests.reference.covariance import covariance
from tests.scenes import generator, relative_error
from tests.training.density.sets import copies, equal, make_gaussians, trained
from warpgs.runs.logger import TrainingLogger
from warpgs.runtime import ranks
from warpgs.runtime.random_numbers import random_numbers
from warpgs.training.density.mcmc import add_noise
from warpgs.training.density.operations import MIN_OPACITY

LOSS = dataclasses.replace(tiny.CONFIG.loss, opacity=0.01, scale=0.01)
DENSIFY = dataclasses.replace(tiny.CONFIG.densify, strategy="mcmc", weakest=0.0)
CONFIG = dataclasses.replace(tiny.CONFIG, loss=LOSS, densify=DENSIFY, omit=("vdp",))


def noisy(gaussians, normal, factor=2.0):
    """By how much positions change; nothing else does."""
    before = copies(gaussians)
    add_noise(gaussians, normal, torch.tensor(factor))
    after = copies(gaussians)
    assert equal({**after, "means": before["means"]}, before)
    return after["means"] - before["means"]


def test_noise_is_multiplied_by_the_covariance_and_the_gate():
    opacities = torch.tensor([0.002, 0.005, 0.02])
    gaussians, normal = make_gaussians([0.9, 0.5, 0.7], opacities), torch.randn(3, 3, generator=generator())
    gaussians.quats.data *= 3.0
    gate = 1.0 / (1.0 + torch.exp(100.0 * (opacities.double() - 0.005)))
    sigma = covariance(gaussians.quats.detach().double(), gaussians.scales.detach().double())
    expected = 2.0 * gate[:, None] * (sigma @ normal.double()[..., None])[..., 0]
    assert relative_error(noisy(gaussians, normal), expected) < 1e-5


def test_opaque_gaussians_get_no_noise():
    gaussians = make_gaussians([0.9, 0.9], torch.tensor([0.3, 1.0]))
    assert noisy(gaussians, torch.ones(2, 3), 1.0).abs().max() < 1e-12


def trainer_with(data, folder, config=CONFIG, **densify):
    return tiny.trainer(data, folder, dataclasses.replace(config, densify=dataclasses.replace(DENSIFY, **densify)))


@pytest.mark.parametrize(
    ("most", "expected"), [(3_000_000, [210, 105]), (306, [204, 102]), (300, [200, 100]), (9, [200, 100])]
)
def test_both_branches_grow_by_a_twentieth_up_to_the_maximum(data, tmp_path, most, expected):
    trainer = trainer_with(data, tmp_path, max_gaussians=most)
    branches = {"static": make_gaussians([0.1] * 200), "dynamic": make_gaussians([0.1] * 100)}
    for name, gaussians in branches.items():
        gaussians.sh_rest.data = gaussians.sh_rest.data[:, :3]
        setattr(trainer.scene, name, gaussians)
    trainer._set_scene(trainer.scene)
    trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    assert [len(trainer.scene.static), len(trainer.scene.dynamic)] == expected


def test_transparent_and_infinite_gaussians_are_relocated(data, tmp_path):
    trainer = trainer_with(data, tmp_path, max_gaussians=0)
    static = trainer.scene.static
    num, (faint, infinite) = len(static), (3, 4)
    static.logit_opacities.data[faint] = -9.0
    static.means.data[infinite] = torch.inf
    trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    assert len(static) == num
    assert static.means.isfinite().all()
    assert static.opacities.min() >= MIN_OPACITY * (1 - 1e-5)


def test_opacities_are_not_reset(data, tmp_path):
    trainer = trainer_with(data, tmp_path)
    before = copies(trainer.scene.static)
    trainer._adapt(tiny.plan_to(trainer, "reset"), Mock(spec=TrainingLogger))
    assert equal(before, copies(trainer.scene.static))


def positions_after(data, folder, iteration=0, rollbacks=0, noise=5e5, is_trained=True):
    """Positions of transparent static Gaussians after the noise of one iteration, and before."""
    trainer = trainer_with(data, folder / f"{iteration} {rollbacks} {noise} {is_trained}", noise=noise)
    trainer.iteration, trainer.rollbacks = iteration, rollbacks
    static = trainer.scene.static
    static.logit_opacities.data[:] = -9.0
    static.means.requires_grad_(is_trained)
    before = static.means.detach().clone()
    for group in trainer.step.optimizer.param_groups:
        group["lr"].fill_(1e-3 if group["name"] == "static.means" else 7.0)
    trainer.step.after_step(trainer._generator)
    return before, static.means.detach()


def test_noise_is_proportional_to_the_learning_rate_of_positions_and_the_covariance_in_view_sizes(data, tmp_path):
    before, after = positions_after(data, tmp_path)
    trainer = trainer_with(data, tmp_path / "again")
    gaussians, unit = trainer.scene.static, trainer.capture.view_size
    gaussians.logit_opacities.data[:] = -9.0
    normal = torch.randn(before.shape, generator=random_numbers(CONFIG.seed, "noise", 0, 0))
    assert relative_error(after - before, noisy(gaussians, normal, 5e5 * 1e-3 / unit**2)) < 1e-3


@pytest.mark.parametrize("off", [{"noise": 0.0}, {"is_trained": False}], ids=str)
def test_positions_that_are_not_trained_and_noise_of_zero_stay(data, tmp_path, off):
    assert torch.equal(*positions_after(data, tmp_path, **off))


def test_noise_is_another_one_in_each_iteration_and_after_a_rollback(data, tmp_path):
    found = [positions_after(data, tmp_path, *at)[1] for at in ((0, 0), (1, 0), (0, 1))]
    assert not any(torch.equal(found[a], found[b]) for a, b in ((0, 1), (0, 2), (1, 2)))


def test_noise_is_the_same_on_all_ranks(data, tmp_path, monkeypatch):
    first = positions_after(data, tmp_path / "0")[1]
    monkeypatch.setattr(ranks, "rank", lambda: 1)
    assert torch.equal(positions_after(data, tmp_path / "1")[1], first)


def test_training_adds_gaussians(data, tmp_path):
    assert len(trained(data, tmp_path, CONFIG).static) > tiny.MODEL.max_static_points
