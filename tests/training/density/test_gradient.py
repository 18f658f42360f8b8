"""Density control by screen-space gradients: clone, split and remove."""

import dataclasses
import math
from unittest.mock import MagicMock, Mock

import pytest
import torch

from tests import plain, tiny
from tests.reference.covariance import covariance
from tests.scenes import error, generator, make_camera, make_splats, relative_error
from tests.training.density.sets import copies, equal, make_gaussians, make_scene, trained
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.runs.logger import TrainingLogger
from warpgs.training.density.gradient import GradientStrategy, Limits, densify
from warpgs.views.views import Views

UNIT = 10.0
CONFIG = plain.densify(gradient=0.5, unit="extent")
SMALL, LARGE = 0.09, 0.11  # around UNIT · split_size = 0.1
HUGE, OVERSIZED = 0.9, 1.1  # around UNIT · max_size = 1
SMALL_GRADIENT, LARGE_GRADIENT = 0.4, 0.6  # around the threshold


def limits(num, capacity=1000):
    """Limits of a densification of ``num`` Gaussians that removes none of them as too large."""
    return Limits(torch.full((num,), UNIT), capacity, remove_large=False)


BRANCHES = ("static", "dynamic")


def densified(sizes, gradients, opacities=0.8, capacity=1000, remove_large=False, seed=5, unit=UNIT):
    """Gaussians before and after one densification, as dicts of tensors."""
    gaussians = make_gaussians(sizes, opacities)
    before = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    units = torch.as_tensor(unit).expand(len(sizes))
    given = Limits(units, capacity, remove_large)
    densify(gaussians, optimizer, torch.tensor(gradients), CONFIG, given, generator(seed))
    return before, copies(gaussians)


def rows_in(tensors, num):
    assert {len(t) for t in tensors.values()} == {num}
    return tensors


def chosen(tensors, index):
    return {name: t[index] for name, t in tensors.items()}


ALL_SMALL = [SMALL_GRADIENT] * 3
SECOND_LARGE = [SMALL_GRADIENT, LARGE_GRADIENT, SMALL_GRADIENT]
THIRD_FAINT = {"opacities": [0.8, 0.8, 0.001]}
# Sizes, gradients and options of a densification that splits none, and the index of the Gaussians after it.
CHOICES = {
    "small gradients change nothing": ([SMALL, LARGE, SMALL], [0.0, SMALL_GRADIENT, CONFIG.gradient], {}, [0, 1, 2]),
    "nor does a large one at the threshold": ([LARGE], [CONFIG.gradient], {}, [0]),
    "a small one with a large gradient is cloned": ([SMALL, SMALL, LARGE], SECOND_LARGE, {}, [0, 1, 2, 1]),
    "transparent ones are removed": ([SMALL, LARGE, SMALL], ALL_SMALL, {"opacities": [0.0049, 0.0051, 0.001]}, [1]),
    "so are those with large gradients": ([SMALL, LARGE], [LARGE_GRADIENT] * 2, {"opacities": 0.0049}, []),
    "oversized ones are removed if requested": ([OVERSIZED, SMALL, HUGE], ALL_SMALL, {"remove_large": True}, [1, 2]),
    "oversized ones are otherwise kept": ([OVERSIZED, SMALL, HUGE], ALL_SMALL, {}, [0, 1, 2]),
    "infinite ones are removed": ([SMALL, math.inf, LARGE], SECOND_LARGE, {}, [0, 2]),
    "those of unknown size are removed": ([SMALL, math.nan, LARGE], SECOND_LARGE, {}, [0, 2]),
    "those with the largest gradients grow": ([SMALL] * 4, [0.7, 0.9, 0.6, 0.8], {"capacity": 2}, [0, 1, 2, 3, 1, 3]),
    "none grow without capacity": ([SMALL, LARGE, SMALL], [LARGE_GRADIENT] * 3, {**THIRD_FAINT, "capacity": 0}, [0, 1]),
    "nor if there are too many": ([SMALL, LARGE, SMALL], [LARGE_GRADIENT] * 3, {**THIRD_FAINT, "capacity": -1}, [0, 1]),
    "of none there are none": ([], [], {"remove_large": True}, []),
}


@pytest.mark.parametrize(("sizes", "gradients", "options", "index"), CHOICES.values(), ids=CHOICES)
def test_gaussians_are_kept_cloned_or_removed(sizes, gradients, options, index):
    before, after = densified(sizes, gradients, **options)
    assert equal(chosen(before, index), after)


def test_a_large_gaussian_with_a_large_gradient_is_split_in_two():
    before, after = densified([SMALL, LARGE, LARGE], [SMALL_GRADIENT, LARGE_GRADIENT, SMALL_GRADIENT])
    assert equal(chosen(before, [0, 2]), chosen(rows_in(after, 4), [0, 1]))
    assert not (after["means"] == before["means"][1]).all(1).any()


LIMIT = UNIT * CONFIG.max_size
# Factors of the maximum size, and whether a Gaussian of it that does not grow, and the children of one that does, stay.
NEAR_LIMITS = {0.99: (True, True), 1.01: (False, True), 1.59: (False, True), 1.61: (False, False)}


@pytest.mark.parametrize(("factor", "stays"), NEAR_LIMITS.items())
@pytest.mark.parametrize("grows", [False, True])
def test_oversized_gaussians_are_split_before_oversized_ones_are_removed(factor, stays, grows):
    gradient = LARGE_GRADIENT if grows else SMALL_GRADIENT
    _, after = densified([SMALL, factor * LIMIT], [SMALL_GRADIENT, gradient], remove_large=True)
    rows_in(after, 1 + stays[grows] * (2 if grows else 1))


def test_an_oversized_gaussian_that_may_not_split_is_removed():
    _, after = densified([SMALL, OVERSIZED], [SMALL_GRADIENT, LARGE_GRADIENT], remove_large=True, capacity=0)
    rows_in(after, 1)


def test_those_that_are_removed_take_no_capacity():
    sizes, gradients = [2.0 * LIMIT, SMALL, SMALL], [0.9, 0.8, SMALL_GRADIENT]
    _, after = densified(sizes, gradients, remove_large=True, capacity=1)
    rows_in(after, 3)


def test_children_of_a_split_are_smaller_by_1_6_along_every_axis():
    before, after = densified([LARGE], [LARGE_GRADIENT])
    expected = (before["log_scales"].double().exp() / 1.6).log().repeat(2, 1)
    assert error(after["log_scales"], expected) < 1e-6


def test_children_of_a_split_keep_rotation_opacity_and_colour():
    before, after = densified([LARGE, LARGE], [LARGE_GRADIENT, LARGE_GRADIENT])
    for name in ("quats", "logit_opacities", "sh_dc", "sh_rest"):
        assert torch.equal(after[name], before[name][[0, 1, 0, 1]])


def test_children_of_a_split_are_distributed_as_their_parent():
    num = 5000
    gaussians = make_gaussians([LARGE])
    gaussians.gather(torch.zeros(num, dtype=torch.int64))
    parent = copies(gaussians)
    _, optimizer = make_scene(gaussians, Gaussians.empty(0))
    densify(gaussians, optimizer, torch.full((num,), LARGE_GRADIENT), CONFIG, limits(num, num), generator())
    offsets = (gaussians.means.detach() - parent["means"][:1]).double()
    expected = covariance(parent["quats"][:1].double(), parent["log_scales"][:1].double().exp())[0]
    assert offsets.shape == (2 * num, 3)
    assert relative_error(offsets.T @ offsets / len(offsets), expected) < 0.03
    assert offsets.mean(0).norm() < 0.03 * LARGE


def test_the_length_of_the_quaternion_does_not_matter_to_children():
    means = []
    for length in (1.0, 7.0):
        gaussians = make_gaussians([LARGE])
        gaussians.quats.data *= length
        _, optimizer = make_scene(gaussians, Gaussians.empty(0))
        densify(gaussians, optimizer, torch.tensor([LARGE_GRADIENT]), CONFIG, limits(1), generator())
        means.append(gaussians.means.detach())
    assert error(means[0], means[1]) < 1e-6


def test_children_depend_on_the_generator_only():
    (_, first), (_, again), (_, other) = (densified([LARGE], [LARGE_GRADIENT], seed=seed) for seed in (1, 1, 2))
    assert equal(first, again)
    assert not torch.equal(first["means"], other["means"])


@pytest.mark.parametrize(("unit", "cloned"), [(UNIT, True), (UNIT / 2, False), (math.inf, True)])
def test_the_size_to_split_at_is_in_units(unit, cloned):
    before, after = densified([SMALL], [LARGE_GRADIENT], unit=unit)
    assert torch.equal(rows_in(after, 2)["log_scales"], before["log_scales"].repeat(2, 1)) == cloned


def test_every_gaussian_has_a_unit_of_its_own():
    units = torch.tensor([UNIT, 2 * UNIT, math.inf, UNIT / 2])
    before, after = densified([OVERSIZED, OVERSIZED, 9.0, HUGE], [SMALL_GRADIENT] * 4, remove_large=True, unit=units)
    assert equal(chosen(before, [1, 2]), after)


def test_a_split_takes_the_capacity_of_one_gaussian():
    _, after = densified([LARGE] * 4, [0.7, 0.9, 0.6, 0.8], capacity=3)
    rows_in(after, 7)


@pytest.mark.parametrize("branch", BRANCHES)
def test_densifying_one_branch_leaves_the_other_unchanged(branch):
    scene, optimizer = make_scene(make_gaussians([SMALL, LARGE]), make_gaussians([LARGE, SMALL, SMALL]))
    ours, other = getattr(scene, branch), getattr(scene, *(set(BRANCHES) - {branch}))
    before, num = copies(other), len(ours)
    densify(ours, optimizer, torch.full((num,), LARGE_GRADIENT), CONFIG, limits(num), generator())
    assert len(ours) == 2 * num
    assert equal(before, copies(other))


@pytest.mark.parametrize("branch", BRANCHES)
def test_moments_of_clones_and_children_start_at_zero(branch):
    scene, optimizer = make_scene(*(make_gaussians([SMALL, LARGE, SMALL]) for _ in BRANCHES))
    gaussians = getattr(scene, branch)
    gradients = torch.tensor([SMALL_GRADIENT, LARGE_GRADIENT, LARGE_GRADIENT])
    densify(gaussians, optimizer, gradients, CONFIG, limits(3), generator())
    for name in PARAMETERS:
        state = optimizer.state[getattr(gaussians, name)]
        for moments in (state["exp_avg"], state["exp_avg_sq"]):
            assert moments.shape == getattr(gaussians, name).shape
            assert (moments[:2] >= 1).all()  # the one that is kept and the parent of the clone
            assert not moments[2:].any()  # the clone and two children


def mean_gradients(num, views):
    """Mean gradients after views, each with the gradients of the offsets on screen and the radii of the Gaussians."""
    strategy, splats = GradientStrategy(CONFIG), make_splats(num)
    strategy.begin(num, torch.device("cpu"))
    for gradients, radii in views:
        strategy.screen_offsets.grad = gradients
        strategy.observe(splats, make_camera(), torch.tensor(radii, dtype=torch.int32)[:, None].repeat(1, 2))
    return strategy.mean()


def test_the_mean_gradient_is_over_the_views_with_the_gaussian_visible():
    norms, direction = torch.tensor([[1.0], [5.0], [2.0]]), torch.tensor([0.6, -0.8])
    views = ((1.0, [1, 0, 1]), (3.0, [1, 0, 0]), (8.0, [1, 0, 1]))
    found = mean_gradients(3, [(scale * norms * direction, seen) for scale, seen in views])
    assert error(found, torch.tensor([(1 + 3 + 8) / 3, 0.0, (2 + 16) / 2])) < 1e-6


def test_gradients_of_culled_gaussians_do_not_count_even_if_not_finite():
    gradients = torch.tensor([[math.nan, 1.0], [0.0, 2.0]])
    assert mean_gradients(2, [(gradients, [0, 3])]).tolist() == [0.0, 2.0]


def test_mean_gradients_without_any_view_are_zero():
    assert not mean_gradients(4, []).any()


def test_views_that_were_rendered_without_gradients_on_screen_do_not_count():
    gradients = torch.tensor([[3.0, 0.0], [0.0, 2.0]])
    assert mean_gradients(2, [(gradients, [1, 1]), (None, [1, 1])]).tolist() == [3.0, 2.0]


@pytest.mark.parametrize(("min_pixels", "most"), [(0, 120), (8, 120), (46, 100), (60, 76), (500, 70)])
def test_a_capture_has_no_more_gaussians_than_its_training_pixels_allow(data, tmp_path, min_pixels, most):
    """The capture has 6 views of 32×24 pixels; training starts with 70 Gaussians, and the config allows 120."""
    densify_config = dataclasses.replace(tiny.CONFIG.densify, min_pixels=min_pixels, gradient=0.0, weakest=0.0)
    schedule = dataclasses.replace(tiny.SCHEDULE, densify_until=10, prune_every=100, reset_every=100)
    scene = trained(data, tmp_path, dataclasses.replace(tiny.CONFIG, densify=densify_config, schedule=schedule))
    assert most - 10 < len(scene.static) + len(scene.dynamic) <= most


@pytest.mark.parametrize(("num_views", "most"), [(6, 576), (23, 2208), (24, 2304), (60, 2304)])
def test_many_frames_allow_no_more_gaussians_than_three_per_pixel_of_an_image(data, tmp_path, num_views, most):
    densify_config = dataclasses.replace(tiny.CONFIG.densify, min_pixels=8, max_gaussians=9_999)
    trainer = tiny.trainer(data, tmp_path, dataclasses.replace(tiny.CONFIG, densify=densify_config))
    views = MagicMock(spec=Views, num_pixels=num_views * 32 * 24)
    views.__len__.return_value = num_views
    change = trainer._adaptation(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    capacity = dataclasses.replace(change, views=views).capacity
    assert capacity + len(trainer.scene.static) + len(trainer.scene.dynamic) == most


@pytest.mark.parametrize(("done", "removed"), [(tiny.SCHEDULE.reset_every, 0), (tiny.SCHEDULE.reset_every + 1, 1)])
def test_oversized_gaussians_are_removed_once_opacities_have_been_reset(data, tmp_path, done, removed):
    trainer = tiny.trainer(data, tmp_path)
    static = trainer.scene.static
    num, plan = len(static), dataclasses.replace(tiny.plan_to(trainer, "densify"), done=done)
    trainer.step.density.resolution[:] = 1.0
    static.log_scales.data[:] = -5.0
    static.log_scales.data[3] = 5.0
    trainer._adapt(plan, Mock(spec=TrainingLogger))
    assert num - len(static) == removed


@pytest.mark.parametrize(("pixels", "is_split"), [(1.9, False), (2.1, True)])
def test_gaussians_are_split_above_a_number_of_pixels_of_the_nearest_view(data, tmp_path, pixels, is_split):
    trainer = tiny.trainer(data, tmp_path)
    for _ in range(3):
        plan = trainer.protocol.at(trainer.iteration)
        trainer.step(plan, trainer._sample(plan))
        trainer.iteration += 1
    density, static = trainer.step.density, trainer.scene.static
    seen = density.resolution[: len(static)].argmax()
    density.total.zero_()[seen] = 1.0
    static.log_scales.data[seen] = math.log(pixels / density.resolution[seen])
    num, before = len(static), static.means[seen].clone()
    trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    assert len(static) == num + 1
    assert (static.means == before).all(1).sum() == (0 if is_split else 2)
