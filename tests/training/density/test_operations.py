"""Changes of a set of Gaussians that strategies share."""

import copy
import dataclasses
from unittest.mock import Mock

import pytest
import torch

from tests import tiny
from tests.reference.covariance import rotation
from tests.scenes import error, generator, relative_error
from tests.training.density.sets import NETWORK, copies, equal, make_gaussians, make_scene, trained
from warpgs.config import DensifyConfig
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.runs.logger import TrainingLogger
from warpgs.training.density.operations import clone, remove, rotated, shorten_needles, split

SIZE = 0.1


def changed(change, num=5):
    """``num`` Gaussians before and after a change of them and their optimizer, and the moments after it."""
    gaussians = make_gaussians([SIZE * (k + 1) for k in range(num)])
    before = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    change(gaussians, optimizer)
    moments = [optimizer.state[p][name] for p in gaussians.parameters() for name in ("exp_avg", "exp_avg_sq")]
    assert all(len(tensor) == len(gaussians) for tensor in moments)
    return before, copies(gaussians), moments


def rows(tensors, index):
    return {name: tensor[index] for name, tensor in tensors.items()}


@pytest.mark.parametrize("indices", [[], [1], [4, 0, 2], [0, 1, 2, 3, 4]], ids=str)
def test_the_gaussians_that_are_not_removed_keep_their_order_and_moments(indices):
    index = torch.tensor(indices, dtype=torch.int64)
    before, after, moments = changed(lambda gaussians, optimizer: remove(gaussians, optimizer, index))
    assert equal(rows(before, [k for k in range(5) if k not in indices]), after)
    assert all((tensor >= 1).all() for tensor in moments)


@pytest.mark.parametrize("indices", [[], [1], [3, 0, 3]], ids=str)
def test_clones_are_appended_without_moments(indices):
    index = torch.tensor(indices, dtype=torch.int64)
    before, after, moments = changed(lambda gaussians, optimizer: clone(gaussians, optimizer, index))
    assert equal(rows(before, [*range(5), *indices]), after)
    assert all((tensor[:5] >= 1).all() and not tensor[5:].any() for tensor in moments)


@pytest.mark.parametrize("indices", [[1], [3, 0]], ids=str)
def test_two_children_without_moments_take_the_place_of_a_parent(indices):
    index, others = torch.tensor(indices, dtype=torch.int64), [k for k in range(5) if k not in indices]
    before, after, moments = changed(lambda gaussians, optimizer: split(gaussians, optimizer, index, generator()))
    kept, children = rows(after, slice(len(others))), rows(after, slice(len(others), None))
    assert equal(rows(before, others), kept)
    assert torch.equal(children["sh_dc"], before["sh_dc"][indices * 2])
    assert error(children["log_scales"].exp() * 1.6, before["log_scales"][indices * 2].exp()) < 1e-6
    assert all((tensor[: len(others)] >= 1).all() and not tensor[len(others) :].any() for tensor in moments)


def test_splitting_none_changes_nothing():
    before, after, _ = changed(lambda gaussians, optimizer: split(gaussians, optimizer, torch.arange(0), generator()))
    assert equal(before, after)


def test_a_quaternion_of_any_length_rotates_as_its_matrix_does():
    g = generator()
    vectors, quats = torch.randn(9, 3, generator=g), 5.0 * torch.randn(9, 4, generator=g)
    expected = (rotation(quats.double()) @ vectors.double()[..., None])[..., 0]
    assert relative_error(rotated(vectors, quats), expected) < 1e-6


def shortened(scales, max_elongation=10.0):
    """Scales after shortening, in scene units; up to a size of 1, any shape is allowed."""
    gaussians = make_gaussians([SIZE] * len(scales))
    gaussians.log_scales.data = torch.tensor(scales).log()
    before = copies(gaussians)
    shorten_needles(gaussians, max_elongation, torch.ones(len(gaussians)))
    changed = [name for name, value in copies(gaussians).items() if not torch.equal(value, before[name])]
    assert changed in ([], ["log_scales"])
    return gaussians.scales.detach()


def test_needles_are_shortened_to_a_multiple_of_their_second_longest_axis():
    expected = torch.tensor([[0.2, 2.0, 0.1], [3.0, 0.3, 0.3], [1.5, 0.01, 15.0]])
    assert relative_error(shortened([[0.2, 50.0, 0.1], [9.0, 0.3, 0.3], [1.5, 0.01, 15.1]]), expected) < 1e-6


def test_needles_are_not_shortened_below_the_size_of_any_shape():
    expected = torch.tensor([[1.0, 0.001, 0.002], [0.9, 0.001, 0.002]])
    assert relative_error(shortened([[50.0, 0.001, 0.002], [0.9, 0.001, 0.002]]), expected) < 1e-6


@pytest.mark.parametrize("max_elongation", [1.0, 0.5])
def test_flat_gaussians_and_balls_keep_their_shape_at_any_limit(max_elongation):
    scales = [[30.0, 0.001, 30.0], [5.0, 5.0, 5.0]]
    assert relative_error(shortened(scales, max_elongation), torch.tensor(scales)) < 1e-6


def test_shortening_no_gaussians_gives_none():
    gaussians = Gaussians.empty(0)
    shorten_needles(gaussians, 10.0, torch.ones(0))
    assert len(gaussians) == 0


def test_the_size_of_any_shape_is_that_of_each_gaussian():
    gaussians = make_gaussians([SIZE] * 3)
    gaussians.log_scales.data = torch.tensor([[9.0, 0.1, 0.1]]).log().repeat(3, 1)
    shorten_needles(gaussians, 10.0, torch.tensor([0.5, 2.0, torch.inf]))
    assert relative_error(gaussians.scales[:, 0].detach(), torch.tensor([1.0, 2.0, 9.0])) < 1e-6


@pytest.mark.parametrize("unit", ["extent", "pixel"])
def test_static_needles_alone_are_shortened_in_the_unit_of_densification(data, tmp_path, unit):
    densify_config = dataclasses.replace(tiny.CONFIG.densify, max_elongation=10.0, unit=unit)
    trainer = tiny.trainer(data, tmp_path, dataclasses.replace(tiny.CONFIG, densify=densify_config))
    needles, extent = make_gaussians([SIZE]), trainer.capture.extent
    needles.log_scales.data = torch.tensor([[0.001, 9.0, 0.001]]).log()
    trainer._set_scene(SplitScene(needles, copy.deepcopy(needles), NETWORK, torch.zeros(3), torch.ones(3)))
    trainer.step.density.resolution[:] = 4.0
    trainer._adapt(tiny.plan_to(trainer, "shorten"), Mock(spec=TrainingLogger))
    assert abs(extent - 1.0) > 0.1
    expected = {"extent": 0.1 * extent, "pixel": 20.0 / 4.0}[unit]
    assert trainer.scene.static.scales.max().item() == pytest.approx(expected, rel=1e-5)
    assert trainer.scene.dynamic.scales.max().item() == pytest.approx(9.0, rel=1e-5)


@pytest.mark.parametrize("frozen", ["nothing", "all"])
def test_training_with_a_limit_ends_without_static_needles(data, tmp_path, monkeypatch, frozen):
    monkeypatch.setattr(DensifyConfig, "max_size", 1e-6)
    limit = dataclasses.replace(tiny.CONFIG.densify, max_elongation=1.05)
    schedule = dataclasses.replace(tiny.SCHEDULE, reset_every=100)  # until then nothing is removed as too large
    config = dataclasses.replace(tiny.CONFIG, frozen=frozen, schedule=schedule)
    elongations = []
    for densify_config in (config.densify, limit):
        folder = tmp_path / str(densify_config.max_elongation)
        scene = trained(data, folder, dataclasses.replace(config, densify=densify_config))
        axes = scene.static.scales.detach().sort(1).values
        elongations.append((axes[:, 2] / axes[:, 1]).max())
    assert elongations[0] > 1.1
    assert elongations[1] <= 1.05 * (1 + 1e-5)
