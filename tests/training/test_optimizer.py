"""Adam, its learning rates, and how its state follows the Gaussians."""

import math

import pytest
import torch

from tests import plain, tiny
from tests.reference.adam import adam
from tests.scenes import error, generator, random_gaussians
from warpgs.model.gaussians import PARAMETERS
from warpgs.model.scene import SplitScene
from warpgs.training.density.operations import gather, reset_moments
from warpgs.training.optimizer import (
    BRANCHES,
    GROUPS,
    RatePlan,
    exponential,
    learning_rates,
    make_optimizer,
)

NETWORK = plain.model(position_bands=1, time_bands=1, depth=2, width=3)
NETWORKS = ("deformation", "appearance")
START = dict.fromkeys(NETWORKS, 0.0)
END = dict.fromkeys(NETWORKS, 1.0)
RATES = plain.optim(means=0.1, sh_dc=0.5, networks=0.7, networks_end=0.07)


def make_scene(num_static=5, num_dynamic=4):
    torch.manual_seed(0)
    static, dynamic = random_gaussians(num_static, 1), random_gaussians(num_dynamic, 2)
    return SplitScene(static, dynamic, NETWORK, torch.zeros(3), torch.ones(3))


def random_gradients(scene, seed):
    g = generator(seed)
    return {name: torch.randn(p.shape, generator=g) for name, p in scene.named_parameters()}


def step(scene, optimizer, gradients):
    for name, parameter in scene.named_parameters():
        parameter.grad = gradients[name].clone()
    optimizer.step()
    optimizer.zero_grad()


def trained(num_steps=3, rate=0.01, **sizes):
    scene = make_scene(**sizes)
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(rate))
    for seed in range(num_steps):
        step(scene, optimizer, random_gradients(scene, seed))
    return scene, optimizer


WARM = dict.fromkeys(NETWORKS, 1.0)


def rates_at(progress, network_progress, unit=1.0, config=RATES, warmup_factors=WARM, means_progress=None, settle=0.0):
    means_progress = dict.fromkeys(BRANCHES, progress) if means_progress is None else means_progress
    at = RatePlan(progress, settle, means_progress, network_progress, warmup_factors)
    return learning_rates(config, unit, at)


def test_every_parameter_of_a_scene_is_in_the_group_of_its_name():
    scene = make_scene()
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.0))
    group_from_parameter = {id(p): group["name"] for group in optimizer.param_groups for p in group["params"]}
    for name, parameter in scene.named_parameters():
        network_or_parameter = name.split(".")[0] if name.startswith(NETWORKS) else name
        assert group_from_parameter[id(parameter)] == network_or_parameter
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(list(scene.parameters()))


def test_steps_are_those_of_adam():
    scene = make_scene()
    start = {name: p.detach().double() for name, p in scene.named_parameters()}
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.01))
    gradients = [random_gradients(scene, seed) for seed in range(1, 5)]
    for named in gradients:
        step(scene, optimizer, named)
    for name, parameter in scene.named_parameters():
        expected, _, _ = adam(start[name], [named[name].double() for named in gradients], 0.01, (0.9, 0.999), 1e-15)
        assert error(parameter.detach(), expected) < 1e-6


def test_the_step_does_not_depend_on_the_size_of_the_gradient():
    scene = make_scene()
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.01))
    before = scene.static.means.detach().clone()
    gradients = {name: torch.full_like(p, 1e-10) for name, p in scene.named_parameters()}
    step(scene, optimizer, gradients)
    assert error(before - scene.static.means.detach(), torch.full_like(before, 0.01)) < 1e-6


@pytest.mark.parametrize("group", GROUPS)
def test_each_group_has_its_own_learning_rate(group):
    scene = make_scene()
    rates = tiny.equal_rates(0.0)
    optimizer = make_optimizer(dict(scene.named_parameters()), rates)
    before = {name: p.detach().clone() for name, p in scene.named_parameters()}
    rates[group].fill_(0.125)  # after construction: the optimizer reads its rates in every step
    step(scene, optimizer, {name: torch.ones_like(p) for name, p in scene.named_parameters()})
    for name, parameter in scene.named_parameters():
        rate = 0.125 if name == group or name.startswith(group + ".") else 0.0
        assert error(before[name] - parameter.detach(), torch.full_like(parameter, rate)) < 1e-5


def test_parameters_without_gradient_stay_constant():
    scene, optimizer = trained()
    before = scene.static.means.detach().clone()
    scene.dynamic.means.grad = torch.ones(4, 3)
    optimizer.step()
    assert torch.equal(scene.static.means, before)


@pytest.mark.parametrize("branch", ["static", "dynamic"])
def test_all_have_the_values_of_their_parents_and_only_kept_gaussians_their_moments(branch):
    scene, optimizer = trained()
    gaussians = getattr(scene, branch)
    values = {name: getattr(gaussians, name).detach().clone() for name in PARAMETERS}
    before = {name: dict(optimizer.state[getattr(gaussians, name)]) for name in PARAMETERS}
    gather(gaussians, optimizer, torch.tensor([3, 0, 1, 1, 3]), num_kept=3)
    for name in PARAMETERS:
        after = optimizer.state[getattr(gaussians, name)]
        assert torch.equal(getattr(gaussians, name), values[name][[3, 0, 1, 1, 3]])
        for part in ("exp_avg", "exp_avg_sq"):
            assert after[part].shape == getattr(gaussians, name).shape
            assert torch.equal(after[part][:3], before[name][part][[3, 0, 1]])
            assert before[name][part][[1, 3]].all()
            assert not after[part][3:].any()


def test_resizing_does_not_change_the_next_steps_of_kept_gaussians():
    (resized, its_optimizer), (untouched, optimizer) = trained(), trained()
    kept = torch.tensor([4, 1, 2])
    gather(resized.static, its_optimizer, torch.cat([kept, kept[:1]]), num_kept=3)
    for seed in (10, 11):
        gradients = random_gradients(untouched, seed)
        shared = {
            name: torch.cat([g[kept], torch.zeros_like(g[:1])]) if name.startswith("static.") else g
            for name, g in gradients.items()
        }
        step(untouched, optimizer, gradients)
        step(resized, its_optimizer, shared)
    for name in PARAMETERS:
        expected = getattr(untouched.static, name)[kept]
        assert error(getattr(resized.static, name)[:3], expected) < 1e-6


def test_resizing_one_branch_leaves_everything_else_unchanged():
    scene, optimizer = trained()
    others = {name: p for name, p in scene.named_parameters() if not name.startswith("static.")}
    before = {name: {k: v.clone() for k, v in optimizer.state[p].items()} for name, p in others.items()}
    values = {name: p.detach().clone() for name, p in others.items()}
    gather(scene.static, optimizer, torch.tensor([0]), num_kept=1)
    for name, parameter in others.items():
        assert torch.equal(parameter, values[name])
        assert all(torch.equal(optimizer.state[parameter][key], value) for key, value in before[name].items())


def test_resizing_before_the_first_step_needs_no_moments():
    scene = make_scene()
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.01))
    gather(scene.static, optimizer, torch.tensor([1, 1, 1]), num_kept=1)
    before = scene.static.means.detach().clone()
    step(scene, optimizer, {name: torch.ones_like(p) for name, p in scene.named_parameters()})
    assert error(before - scene.static.means.detach(), torch.full((3, 3), 0.01)) < 1e-5


def test_training_continues_after_all_gaussians_were_removed():
    scene, optimizer = trained()
    gather(scene.dynamic, optimizer, torch.zeros(0, dtype=torch.int64), num_kept=0)
    step(scene, optimizer, random_gradients(scene, 9))
    assert len(scene.dynamic) == 0
    assert optimizer.state[scene.dynamic.sh_rest]["exp_avg"].shape == (0, 15, 3)


def test_a_reset_sets_the_moments_of_one_parameter_to_zero():
    scene, optimizer = trained()
    reset_moments(optimizer, scene.static.logit_opacities)
    for name, parameter in scene.named_parameters():
        state = optimizer.state[parameter]
        for part in ("exp_avg", "exp_avg_sq"):
            assert state[part].any() == (name != "static.logit_opacities")


def test_a_reset_of_an_untrained_parameter_changes_nothing():
    scene = make_scene()
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.0))
    reset_moments(optimizer, scene.static.means)
    assert not optimizer.state.get(scene.static.means, {})


@pytest.mark.parametrize(("start", "end"), [(8e-4, 1.6e-6), (1e-3, 1e-3), (1e-6, 1.0), (3.0, 0.2)])
@pytest.mark.parametrize("progress", [-0.5, 0.0, *(k / 10 for k in range(1, 10)), 1.0, 1.5])
def test_an_exponential_schedule_interpolates_and_is_constant_outside_its_range(start, end, progress):
    expected = start * (end / start) ** min(max(progress, 0.0), 1.0)
    assert exponential(start, end, progress) == pytest.approx(expected, rel=1e-12)


def test_each_rate_of_the_config_reaches_its_group():
    rates = rates_at(0.0, START)
    for branch in ("static", "dynamic"):
        parameters = [rates[f"{branch}.{name}"] for name in PARAMETERS]
        assert parameters == pytest.approx([0.1, 1e-3, 5e-3, 0.05, 0.5, 1.25e-4])
    assert [rates[name] for name in NETWORKS] == pytest.approx([0.7, 0.7])


@pytest.mark.parametrize(("progress", "factor"), [(0.0, 1.0), (0.5, 0.1), (1.0, 0.01)])
def test_the_rate_of_positions_decays_to_a_hundredth_in_a_unit(progress, factor):
    rates = rates_at(progress, START, unit=3.0)
    for branch in ("static", "dynamic"):
        assert rates[f"{branch}.means"] == pytest.approx(0.1 * 3.0 * factor)


def test_the_rate_of_positions_decays_by_branch():
    rates = rates_at(0.3, START, means_progress={"static": 1.0, "dynamic": 0.5})
    assert rates["static.means"] == pytest.approx(0.1 * 0.01)
    assert rates["dynamic.means"] == pytest.approx(0.1 * 0.1)


def test_gaussians_settle_at_a_tenth_of_their_rates():
    before, halfway, end = (rates_at(0.9, START, settle=settle) for settle in (0.0, 0.5, 1.0))
    settling = {f"{branch}.{name}" for branch in BRANCHES for name in PARAMETERS if name != "means"}
    settling.add("dynamic.reflectances")
    assert before == rates_at(0.9, START)
    for rates, factor in ((halfway, math.sqrt(0.1)), (end, 0.1)):
        expected = {name: rate * (factor if name in settling else 1.0) for name, rate in before.items()}
        assert rates == pytest.approx(expected)


def test_the_other_rates_of_gaussians_depend_neither_on_progress_nor_on_the_unit():
    now, later = rates_at(0.0, START), rates_at(0.9, END, unit=5.0)
    changed = {name for name in GROUPS if now[name] != later[name]}
    assert changed == {"static.means", "dynamic.means", *NETWORKS, "light", "dome"}


def test_each_network_has_its_own_progress():
    rates = rates_at(0.3, {"deformation": 0.5, "appearance": 1.0})
    assert rates["deformation"] == pytest.approx(math.sqrt(0.7 * 0.07))
    assert rates["appearance"] == pytest.approx(0.07)


def test_the_default_rates_of_networks_are_those_of_the_paper():
    now, later = rates_at(0.0, START, config=plain.optim()), rates_at(1.0, END, config=plain.optim())
    for name in NETWORKS:
        assert now[name] == pytest.approx(8e-4)
        assert later[name] == pytest.approx(1.6e-6)


def test_a_rate_of_zero_stays_zero():
    rates = torch.tensor([exponential(0.0, 0.0, progress) for progress in (0.0, 0.5, 1.0)])
    assert not rates.any()


def test_the_warmup_factor_scales_the_rate_of_one_network():
    progress = dict.fromkeys(NETWORKS, 0.3)
    warm = rates_at(0.3, progress)
    for name in NETWORKS:
        scaled = rates_at(0.3, progress, warmup_factors={**WARM, name: 0.25})
        assert scaled == {**warm, name: pytest.approx(0.25 * warm[name])}
