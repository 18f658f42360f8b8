"""Growth of a set of Gaussians: clone, split, remove, reset."""

import math

import pytest
import torch

from tests.reference.covariance import covariance
from tests.scenes import error, generator, relative_error
from warpgs.config import DensifyConfig, ModelConfig
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.model.scene import SplitScene
from warpgs.training.densify import GradientStatistics, densify, reset_opacities
from warpgs.training.optimizer import GROUPS, make_optimizer

EXTENT = 2.0
CONFIG = DensifyConfig(gradient=0.5, dense_fraction=0.05, min_opacity=0.1, max_size=0.5)
SMALL, LARGE = 0.09, 0.11  # around EXTENT · dense_fraction = 0.1
HUGE, OVERSIZED = 0.9, 1.1  # around EXTENT · max_size = 1
CALM, LIVELY = 0.4, 0.6
NETWORK = ModelConfig(position_bands=1, time_bands=1, depth=1, width=2)
BRANCHES = ("static", "dynamic")


def make_gaussians(sizes, opacities=0.8):
    """Needles of the given sizes, each twice as long as thick."""
    g, num = generator(), len(sizes)
    scales = torch.tensor(sizes).reshape(-1, 1) * torch.tensor([[0.5, 1.0, 0.5]])
    return Gaussians(
        torch.randn(num, 3, generator=g),
        torch.randn(num, 4, generator=g),
        scales.log(),
        torch.logit(torch.as_tensor(opacities, dtype=torch.float32).expand(num)).clone(),
        torch.randn(num, 1, 3, generator=g),
        torch.randn(num, 15, 3, generator=g),
    )


def make_scene(static, dynamic):
    """A scene, and its optimizer after one step in which nothing moved but every moment became 1 and more."""
    scene = SplitScene(static, dynamic, NETWORK, torch.zeros(3), torch.ones(3))
    optimizer = make_optimizer(scene, torch.zeros(len(GROUPS)))
    for parameter in scene.parameters():
        parameter.grad = torch.full_like(parameter, 100.0)
    optimizer.step()
    return scene, optimizer


def copies(gaussians):
    return {name: getattr(gaussians, name).detach().clone() for name in PARAMETERS}


def grown(sizes, gradients, opacities=0.8, room=1000, remove_large=False, seed=5, extent=EXTENT):
    """Gaussians before and after one densification, as dicts of tensors."""
    gaussians = make_gaussians(sizes, opacities)
    before = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    densify(gaussians, optimizer, torch.tensor(gradients), extent, CONFIG, room, remove_large, generator(seed))
    return before, copies(gaussians)


def rows_in(tensors, num):
    assert {len(t) for t in tensors.values()} == {num}
    return tensors


def equal(a, b):
    return all(torch.equal(a[name], b[name]) for name in PARAMETERS)


def chosen(tensors, index):
    return {name: t[index] for name, t in tensors.items()}


def test_nothing_happens_where_no_gradient_exceeds_the_threshold():
    before, after = grown([SMALL, LARGE, SMALL, LARGE], [0.0, CALM, CONFIG.gradient, CONFIG.gradient])
    assert equal(before, after)


def test_a_small_gaussian_of_large_gradient_is_cloned():
    before, after = grown([SMALL, SMALL, LARGE], [CALM, LIVELY, CALM])
    assert equal(chosen(before, [0, 1, 2, 1]), rows_in(after, 4))


def test_a_large_gaussian_of_large_gradient_gives_way_to_two_children():
    before, after = grown([SMALL, LARGE, LARGE], [CALM, LIVELY, CALM])
    assert equal(chosen(before, [0, 2]), chosen(rows_in(after, 4), [0, 1]))
    assert not (after["means"] == before["means"][1]).all(1).any()


def test_children_of_a_split_are_smaller_by_1_6_along_every_axis():
    before, after = grown([LARGE], [LIVELY])
    expected = (before["log_scales"].double().exp() / 1.6).log().repeat(2, 1)
    assert error(after["log_scales"], expected) < 1e-6


def test_children_of_a_split_keep_rotation_opacity_and_colour():
    before, after = grown([LARGE, LARGE], [LIVELY, LIVELY])
    for name in ("quats", "logit_opacities", "sh_dc", "sh_rest"):
        assert torch.equal(after[name], before[name][[0, 1, 0, 1]])


def test_children_of_a_split_scatter_as_their_parent_does():
    num = 5000
    gaussians = make_gaussians([LARGE])
    gaussians.gather(torch.zeros(num, dtype=torch.int64))
    parent = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    densify(gaussians, optimizer, torch.full((num,), LIVELY), EXTENT, CONFIG, num, False, generator())
    offsets = (gaussians.means.detach() - parent["means"][:1]).double()
    expected = covariance(parent["quats"][:1].double(), parent["log_scales"][:1].double().exp())[0]
    assert offsets.shape == (2 * num, 3)
    assert relative_error(offsets.T @ offsets / len(offsets), expected) < 0.03
    assert offsets.mean(0).norm() < 0.03 * LARGE


def test_the_length_of_the_quaternion_does_not_move_the_children():
    means = []
    for length in (1.0, 7.0):
        gaussians = make_gaussians([LARGE])
        gaussians.quats.data *= length
        _, optimizer = make_scene(gaussians, Gaussians.empty(0))
        densify(gaussians, optimizer, torch.tensor([LIVELY]), EXTENT, CONFIG, 9, False, generator())
        means.append(gaussians.means.detach())
    assert error(means[0], means[1]) < 1e-6


def test_children_depend_on_the_generator_alone():
    (_, first), (_, again), (_, other) = (grown([LARGE], [LIVELY], seed=seed) for seed in (1, 1, 2))
    assert equal(first, again)
    assert not torch.equal(first["means"], other["means"])


@pytest.mark.parametrize(("extent", "cloned"), [(EXTENT, True), (EXTENT / 2, False)])
def test_what_is_large_is_a_share_of_the_extent(extent, cloned):
    before, after = grown([SMALL], [LIVELY], extent=extent)
    assert torch.equal(rows_in(after, 2)["log_scales"], before["log_scales"].repeat(2, 1)) == cloned


def test_faint_gaussians_are_removed():
    before, after = grown([SMALL, LARGE, SMALL], [CALM, CALM, CALM], opacities=[0.09, 0.11, 0.01])
    assert equal(chosen(before, [1]), after)


def test_faint_gaussians_do_not_grow_however_large_their_gradient():
    _, after = grown([SMALL, LARGE], [LIVELY, LIVELY], opacities=0.09)
    rows_in(after, 0)


def test_oversized_gaussians_are_removed_once_that_is_asked_for():
    before, after = grown([OVERSIZED, SMALL, HUGE], [CALM, CALM, CALM], remove_large=True)
    assert equal(chosen(before, [1, 2]), after)


def test_oversized_gaussians_stay_until_that_is_asked_for():
    before, after = grown([OVERSIZED, SMALL], [CALM, CALM], remove_large=False)
    assert equal(before, after)


@pytest.mark.parametrize("size", [math.inf, math.nan])
def test_gaussians_without_a_finite_size_are_removed(size):
    before, after = grown([SMALL, size, LARGE], [CALM, LIVELY, CALM])
    assert equal(chosen(before, [0, 2]), after)


def test_those_of_the_largest_gradients_take_the_room_there_is():
    before, after = grown([SMALL] * 4, [0.7, 0.9, 0.6, 0.8], room=2)
    assert equal(chosen(before, [0, 1, 2, 3, 1, 3]), rows_in(after, 6))


def test_a_split_takes_the_room_of_one():
    _, after = grown([LARGE] * 4, [0.7, 0.9, 0.6, 0.8], room=3)
    rows_in(after, 7)


@pytest.mark.parametrize("room", [0, -3])
def test_without_room_nothing_grows_but_the_faint_still_go(room):
    before, after = grown([SMALL, LARGE, SMALL], [LIVELY] * 3, opacities=[0.8, 0.8, 0.01], room=room)
    assert equal(chosen(before, [0, 1]), after)


@pytest.mark.parametrize("branch", BRANCHES)
def test_one_branch_grows_without_the_other(branch):
    scene, optimizer = make_scene(make_gaussians([SMALL, LARGE]), make_gaussians([LARGE, SMALL, SMALL]))
    ours, other = getattr(scene, branch), getattr(scene, *(set(BRANCHES) - {branch}))
    before, num = copies(other), len(ours)
    densify(ours, optimizer, torch.full((num,), LIVELY), EXTENT, CONFIG, 1000, False, generator())
    assert len(ours) == 2 * num
    assert equal(before, copies(other))


@pytest.mark.parametrize("branch", BRANCHES)
def test_clones_and_children_begin_without_moments(branch):
    scene, optimizer = make_scene(*(make_gaussians([SMALL, LARGE, SMALL]) for _ in BRANCHES))
    gaussians = getattr(scene, branch)
    densify(gaussians, optimizer, torch.tensor([CALM, LIVELY, LIVELY]), EXTENT, CONFIG, 9, False, generator())
    for name in PARAMETERS:
        state = optimizer.state[getattr(gaussians, name)]
        for moments in (state["exp_avg"], state["exp_avg_sq"]):
            assert moments.shape == getattr(gaussians, name).shape
            assert (moments[:2] >= 1).all()  # the calm one and the parent of the clone
            assert not moments[2:].any()  # the clone and two children


def test_no_gaussians_stay_none():
    _, after = grown([], [], remove_large=True)
    rows_in(after, 0)


def test_the_mean_gradient_is_over_the_views_that_saw_a_gaussian():
    statistics = GradientStatistics(3, torch.device("cpu"))
    norms = torch.tensor([[1.0, 9.0], [5.0, 9.0], [2.0, 9.0]])
    for scale, seen in ((1.0, [1, 0, 1]), (3.0, [1, 0, 0]), (8.0, [1, 0, 1])):
        statistics.observe(scale * norms, torch.tensor(seen, dtype=torch.int32)[:, None].repeat(1, 2))
    assert error(statistics.mean(), torch.tensor([(1 + 3 + 8) / 3, 0.0, (2 + 16) / 2])) < 1e-6


def test_gradients_of_what_a_view_did_not_see_do_not_count_even_if_not_finite():
    statistics = GradientStatistics(2, torch.device("cpu"))
    radii = torch.tensor([[0, 0], [3, 4]], dtype=torch.int32)
    statistics.observe(torch.tensor([[math.nan, math.nan], [2.0, 2.0]]), radii)
    assert statistics.mean().tolist() == [0.0, 2.0]


def test_statistics_without_a_view_ask_for_no_growth():
    assert not GradientStatistics(4, torch.device("cpu")).mean().any()


def test_a_reset_lowers_opacities_to_a_hundredth_and_raises_none():
    given = torch.tensor([0.9, 0.011, 0.009, 0.0001])
    gaussians = make_gaussians([SMALL] * 4, given)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    reset_opacities(gaussians, optimizer)
    assert error(gaussians.opacities.detach(), given.clamp(max=0.01)) < 1e-7


def test_a_reset_changes_nothing_but_opacities():
    gaussians = make_gaussians([SMALL, LARGE])
    before = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    reset_opacities(gaussians, optimizer)
    changed = [name for name, value in copies(gaussians).items() if not torch.equal(value, before[name])]
    assert changed == ["logit_opacities"]


def test_a_reset_forgets_the_moments_of_opacities_alone():
    gaussians = make_gaussians([SMALL, LARGE])
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    reset_opacities(gaussians, optimizer)
    for name in PARAMETERS:
        state = optimizer.state[getattr(gaussians, name)]
        for moment in ("exp_avg", "exp_avg_sq"):
            assert state[moment].any() == (name != "logit_opacities")
