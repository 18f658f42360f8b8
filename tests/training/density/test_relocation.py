"""Copies of a Gaussian that together look as it did, and where they go."""

import math

import pytest
import torch

from tests.scenes import error, generator, relative_error
from tests.training.density.sets import copies, equal, make_gaussians, make_scene
from warpgs.cameras import Camera
from warpgs.model.gaussians import Gaussians
from warpgs.model.splats import Splats
from warpgs.rendering import render
from warpgs.training.density.relocation import MAX_COPIES, relocated, respawn

TINY = 1e-9
"""A minimum opacity that no copy reaches."""

OPACITIES = torch.tensor([0.01, 0.3, 0.5, 0.9, 0.99, 0.9999])
COUNTS = (1, 2, 3, 10, MAX_COPIES)


def double_sum(opacity, count):
    """Opacity and relative size of Eq. 9 as it is printed."""
    each = 1.0 - (1.0 - opacity) ** (1.0 / count)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, count + 1)
        for k in range(i)
    )
    return each, opacity / total


@pytest.mark.parametrize("count", COUNTS)
def test_copies_have_the_opacity_and_size_of_the_paper(count):
    found = relocated(OPACITIES, torch.full_like(OPACITIES, count, dtype=torch.int64), TINY)
    expected = torch.tensor([double_sum(opacity, count) for opacity in OPACITIES.double().tolist()]).T
    for actual, values in zip(found, expected, strict=True):
        assert ((actual - values) / values).abs().max() < 2e-6


@pytest.mark.parametrize("count", COUNTS)
def test_stacked_copies_keep_the_opacity_of_the_centre_and_its_integral_along_a_line(count):
    each, factors = relocated(OPACITIES, torch.full_like(OPACITIES, count, dtype=torch.int64), TINY)
    x = torch.linspace(-9.0, 9.0, 20_001, dtype=torch.float64)
    for opacity, a, size in zip(OPACITIES.double(), each.double(), factors.double(), strict=True):
        together = 1.0 - (1.0 - a * torch.exp(-0.5 * (x / size) ** 2)) ** count
        assert together.max().item() == pytest.approx(opacity.item(), rel=1e-5)
        assert together.mean().item() == pytest.approx((opacity * torch.exp(-0.5 * x**2)).mean().item(), rel=1e-5)


def test_opaque_gaussians_and_too_many_copies_give_finite_values():
    each, factors = relocated(torch.ones(2), torch.tensor([2, 1000]), TINY)
    assert ((each > 0.2) & (each < 1.0)).all()
    assert ((factors > 0.4) & (factors < 1.0)).all()


def test_copies_are_no_fainter_than_the_minimum():
    each, factors = relocated(torch.tensor([0.006]), torch.tensor([10]), 0.005)
    assert each.tolist() == pytest.approx([0.005])
    assert factors.item() < 0.2  # ten copies of 0.005 are brighter than one of 0.006


OPAQUE = [0.9, 0.001, 0.6, 0.002, 0.3]


def respawned(opacities, is_dead, num_added, seed=4):
    """Gaussians before and after, and the moments after."""
    gaussians = make_gaussians([0.1 * (k + 1) for k in range(len(opacities))], torch.tensor(opacities))
    before = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    respawn(gaussians, optimizer, torch.tensor(is_dead, dtype=torch.bool), num_added, 0.005, generator(seed))
    moments = [optimizer.state[p][name] for p in gaussians.parameters() for name in ("exp_avg", "exp_avg_sq")]
    assert all(len(tensor) == len(gaussians) for tensor in moments)
    return before, copies(gaussians), moments


def sources(before, after):
    """The index before of every Gaussian after, by its colour."""
    same = (after["sh_dc"][:, None, 0] == before["sh_dc"][None, :, 0]).all(2)
    assert (same.sum(1) == 1).all()
    return same.int().argmax(1)


@pytest.mark.parametrize("num_added", [0, 3])
def test_dead_gaussians_become_copies_of_others(num_added):
    before, after, _ = respawned(OPAQUE, [0, 1, 0, 1, 0], num_added)
    source = sources(before, after)
    assert len(source) == 5 + num_added
    assert set(source.tolist()) == {0, 2, 4}
    assert torch.equal(after["means"], before["means"][source])
    assert torch.equal(after["quats"], before["quats"][source])


def test_every_copied_gaussian_and_its_copies_share_its_opacity_and_size():
    before, after, _ = respawned(OPAQUE, [0, 1, 0, 1, 0], 3)
    source = sources(before, after)
    counts = torch.bincount(source, minlength=5)[source]
    each, factors = relocated(before["logit_opacities"].sigmoid()[source], counts, 0.005)
    single = counts == 1
    assert not single.all()
    assert error(after["logit_opacities"].sigmoid(), each) < 1e-6
    assert relative_error(after["log_scales"].exp(), factors[:, None] * before["log_scales"][source].exp()) < 1e-6
    assert torch.equal(after["log_scales"][single], before["log_scales"][source][single])


def test_the_moments_of_copies_and_of_what_was_copied_start_at_zero():
    before, after, moments = respawned([0.5] * 40, [1] * 10 + [0] * 30, 0)
    changed = (torch.bincount(sources(before, after), minlength=40) > 1)[sources(before, after)]
    assert 0 < changed.sum() < len(changed)
    for tensor in moments:
        assert (tensor[~changed] >= 1).all()
        assert not tensor[changed].any()


def test_opaque_gaussians_are_copied_in_proportion_to_their_opacity():
    before, after, _ = respawned([0.8, 0.2], [0, 0], 10_000)
    drawn = torch.bincount(sources(before, after), minlength=2) - 1
    assert drawn.sum() == 10_000
    assert drawn[0].item() == pytest.approx(8_000, abs=200)  # five standard deviations


def test_without_dead_ones_and_growth_nothing_changes():
    before, after, _ = respawned(OPAQUE, [0] * 5, 0)
    assert equal(before, after)


@pytest.mark.parametrize("num", [0, 3])
def test_if_all_are_dead_all_are_removed(num):
    _, after, _ = respawned([0.001] * num, [1] * num, 2)
    assert len(after["means"]) == 0


def test_copies_depend_on_the_generator_only():
    first, again, other = (respawned(OPAQUE, [0, 1, 0, 1, 0], 20, seed)[1] for seed in (1, 1, 2))
    assert equal(first, again)
    assert not torch.equal(first["sh_dc"], other["sh_dc"])


def test_the_image_of_a_gaussian_keeps_its_brightness_when_it_is_copied():
    """The peak and the sum along the row through its centre."""
    K = torch.tensor([[100.0, 0.0, 32.5], [0.0, 100.0, 32.5], [0.0, 0.0, 1.0]])
    camera, rows = Camera(torch.eye(4), K, 65, 65), []
    for count in (1, 4):
        each, factors = relocated(torch.tensor([0.8]), torch.tensor([count]), TINY)
        means, quats = torch.tensor([[0.0, 0.0, 2.0]]).repeat(count, 1), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
        scales, colors = (0.1 * factors[:, None]).repeat(count, 3), torch.ones(count, 3)
        rows.append(render(Splats(means, quats, scales, each.repeat(count), colors), camera).joint.image[32, :, 0])
    assert rows[1].max().item() == pytest.approx(rows[0].max().item(), abs=2e-3)
    assert rows[1].sum().item() == pytest.approx(rows[0].sum().item(), rel=2e-2)
