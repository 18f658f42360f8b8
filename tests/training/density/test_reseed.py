"""New dynamic Gaussians where none shows what moves."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch

from tests import plain, tiny
from tests.reference.render import as_dict
from tests.reference.render import render as reference
from tests.scenes import error, select
from warpgs.config import RenderSettings
from warpgs.initialization.dynamic_points import DynamicPoints
from warpgs.initialization.point_cloud import scene_box
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.runs.logger import TrainingLogger
from warpgs.training.density import operations
from warpgs.training.density.reseed import gaussians_that_show, lost_fraction, lost_pixels, require_branches, reseed

PHASE = plain.phase()


@pytest.fixture
def trainer(data, tmp_path):
    """Its dynamic Gaussians are opaque, and its deformation network moves them a little."""
    config = dataclasses.replace(
        tiny.CONFIG,
        model=dataclasses.replace(tiny.MODEL, dynamic_points=200),
        densify=dataclasses.replace(tiny.CONFIG.densify, reseed=0.05, max_gaussians=1_000),
        schedule=dataclasses.replace(tiny.SCHEDULE, warmup=0),
    )
    trainer = tiny.trainer(data, tmp_path / "run", config)
    trainer._add_dynamic_gaussians()
    trainer.scene.dynamic.logit_opacities.data[:] = 3.0
    deform(trainer.scene, 0.05)
    return trainer


def deform(scene, size):
    for parameter in scene.deformation.parameters():
        parameter.data += size * torch.randn(parameter.shape)


def lose_half(trainer):
    """Removes the dynamic Gaussians of one half of the scene."""
    x = trainer.scene.dynamic.means[:, 0]
    kept = (x > x.median()).nonzero()[:, 0]
    operations.gather(trainer.scene.dynamic, trainer.step.optimizer, kept, len(kept))


def test_lost_are_the_dynamic_pixels_that_dynamic_gaussians_alone_leave_transparent(trainer):
    lose_half(trainer)
    mask_of = lost_pixels(trainer.scene, PHASE, RenderSettings())
    view = trainer.views[2]
    with torch.no_grad():
        splats = trainer.scene.splats(view.time, sh_degree=1)
        dynamic = as_dict(select(splats, splats.is_dynamic))
        alpha = reference(dynamic, view.camera, torch.zeros(3, dtype=torch.float64))[1]
    expected = ~view.static_mask & (alpha < 0.1)
    assert torch.equal(mask_of(view), expected)
    assert 0 < expected.sum() < (~view.static_mask).sum()


def test_the_fraction_of_lost_pixels_grows_with_what_is_lost(trainer):
    mask_of = lost_pixels(trainer.scene, PHASE, RenderSettings())
    before = lost_fraction(trainer.views, mask_of)
    lose_half(trainer)
    half = lost_fraction(trainer.views, mask_of)
    trainer.scene.dynamic = Gaussians.empty(0, 1)
    assert before < 0.1 < half < 1.0
    assert lost_fraction(trainer.views, mask_of) == 1.0


def test_added_gaussians_are_deformed_to_where_they_were_seen(trainer):
    positions = trainer.scene.dynamic.means.detach().clone()
    found = DynamicPoints(positions, torch.rand(len(positions), 3), torch.arange(len(positions)) % 3, True)
    added = gaussians_that_show(found, trainer.scene, trainer.views, trainer.config, view_size=1.0)
    assert len(added) == len(positions)
    for index in range(3):
        chosen = found.views == index
        means = added.means[chosen]
        with torch.no_grad():
            offsets = trainer.scene.deformation(means, trainer.views[index].time)[:, :3]
        assert offsets.norm(dim=1).min() > 1e-4
        assert error(means + offsets, positions[chosen]) < 0.01


def test_points_that_no_canonical_position_is_found_for_are_left_out(trainer):
    deform(trainer.scene, 3.0)
    positions = trainer.scene.dynamic.means.detach().clone()
    found = DynamicPoints(
        positions, torch.rand(len(positions), 3), torch.zeros(len(positions), dtype=torch.int64), True
    )
    added = gaussians_that_show(found, trainer.scene, trainer.views, trainer.config, view_size=1.0)
    assert len(added) < len(positions)


def test_appended_gaussians_start_without_moments_and_the_others_keep_theirs(trainer):
    dynamic, optimizer = trainer.scene.dynamic, trainer.step.optimizer
    for parameter in trainer.step.parameters().values():
        parameter.grad = torch.rand_like(parameter)
    optimizer.step()
    before = {name: optimizer.state[getattr(dynamic, name)]["exp_avg"].clone() for name in PARAMETERS}
    num, added = len(dynamic), Gaussians.empty(3, 1)
    operations.append(dynamic, optimizer, added)
    assert len(dynamic) == num + 3
    for name in PARAMETERS:
        moments = optimizer.state[getattr(dynamic, name)]["exp_avg"]
        assert torch.equal(moments[:num], before[name])
        assert before[name].any() == (before[name].numel() > 0)
        assert not moments[num:].any()
        assert torch.equal(getattr(dynamic, name)[num:], getattr(added, name))


@pytest.mark.parametrize("lost", [False, True])
def test_an_object_whose_gaussians_are_lost_gets_new_ones(trainer, capsys, lost):
    trainer.iteration = 11
    plan = trainer.protocol.at(11)
    assert "reseed" in plan.actions
    assert "reseed" not in trainer.protocol.at(12).actions
    if lost:
        lose_half(trainer)
    num, mask_of = len(trainer.scene.dynamic), lost_pixels(trainer.scene, PHASE, RenderSettings())
    with TrainingLogger(trainer.run / "events", trainer.protocol.num_iterations, 11) as logger:
        reseed(trainer._adaptation(plan, logger))
    added = len(trainer.scene.dynamic) - num
    assert (added > 0) == lost
    assert (f"{added:,} added there" in capsys.readouterr().out) == lost
    trainer.scene.dynamic.logit_opacities.data[:] = 3.0
    assert lost_fraction(trainer.views, mask_of) < 0.1


def test_an_empty_background_is_not_filled_if_everything_is_assumed_to_be_dynamic(trainer):
    trainer.capture = trainer.capture.assuming("dynamic")
    lose_half(trainer)
    num = len(trainer.scene.dynamic)
    with TrainingLogger(trainer.run / "events", trainer.protocol.num_iterations, 11) as logger:
        reseed(trainer._adaptation(trainer.protocol.at(11), logger))
    assert len(trainer.scene.dynamic) == num


def make_transparent(gaussians):
    gaussians.logit_opacities.data[:] = -20.0


def test_a_run_ends_when_it_has_lost_the_last_static_gaussian(trainer):
    make_transparent(trainer.scene.static)
    message = r"the last static Gaussian was removed.* but 9\d\.\d% of the training pixels are static: warpgs check"
    with pytest.raises(ValueError, match=message):
        trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))


def test_where_rates_are_far_above_their_defaults_that_error_names_them_instead_of_the_capture(trainer):
    make_transparent(trainer.scene.static)
    optim = dataclasses.replace(trainer.config.optim, means=100.0)
    trainer.config = dataclasses.replace(trainer.config, optim=optim)
    with pytest.raises(ValueError, match=r"pixels are static; --optim\.means is 100, by default 0\.00065$"):
        trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))


def test_dynamic_gaussians_that_are_all_lost_are_added_again_at_once(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path / "run")
    trainer._add_dynamic_gaussians()
    make_transparent(trainer.scene.dynamic)
    logger = Mock(spec=TrainingLogger)
    assert trainer.config.densify.reseed == 0.0
    trainer._adapt(tiny.plan_to(trainer, "densify"), logger)
    assert len(trainer.scene.dynamic) > 10
    assert "100% of the dynamic pixels show no dynamic Gaussian" in logger.log.call_args.args[0]


def test_an_empty_branch_is_filled_where_thin_objects_have_nothing_but_borders_of_their_masks(data, tmp_path):
    config = dataclasses.replace(
        tiny.CONFIG,
        loss=dataclasses.replace(tiny.CONFIG.loss, mask_margin=1.0),
        densify=dataclasses.replace(tiny.CONFIG.densify, reseed=0.05),
    )
    trainer = tiny.trainer(data, tmp_path / "run", config)
    trainer._add_dynamic_gaussians()
    assert all((view.static_mask | view.mask_border).all() for view in trainer.views)
    make_transparent(trainer.scene.dynamic)
    trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    assert len(trainer.scene.dynamic) > 10


def test_an_empty_branch_is_filled_at_random_where_the_deformation_has_no_inverse(trainer):
    make_transparent(trainer.scene.dynamic)
    deform(trainer.scene, 1e4)
    logger = Mock(spec=TrainingLogger)
    trainer._adapt(tiny.plan_to(trainer, "densify"), logger)
    center, half_size = scene_box(trainer.capture.points)
    assert len(trainer.scene.dynamic) > 100
    assert ((trainer.scene.dynamic.means - center).abs() <= half_size).all()
    assert f"{len(trainer.scene.dynamic)} added there" in logger.log.call_args.args[0]


def test_a_run_ends_when_lost_dynamic_gaussians_cannot_be_added_again(trainer):
    make_transparent(trainer.scene.dynamic)
    trainer.config = dataclasses.replace(
        trainer.config, densify=dataclasses.replace(trainer.config.densify, max_gaussians=1)
    )
    message = r"the last dynamic Gaussian was removed.* but \d\.\d% of the training pixels are dynamic.*--assume static"
    with pytest.raises(ValueError, match=message):
        trainer._adapt(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))


@pytest.mark.parametrize("is_needed", [False, True])
def test_a_branch_that_hardly_any_pixel_needs_may_lose_its_last_gaussian(trainer, is_needed):
    static = torch.tensor(9_989 if is_needed else 9_991)
    views = Mock(spec=trainer.views)
    views.map.side_effect = lambda _: iter([(static, 10_000 - static)])
    before, trainer.scene.dynamic = (len(trainer.scene.static), 7), Gaussians.empty(0, 1)
    if is_needed:
        with pytest.raises(ValueError, match=r"but 0\.1% of the training pixels are dynamic"):
            require_branches(before, trainer.scene, views, trainer.config)
    else:
        assert require_branches(before, trainer.scene, views, trainer.config) == (
            "the last dynamic Gaussian was removed, as transparent, oversized or rarely seen; 0.09% of the training "
            "pixels are dynamic"
        )


def test_a_branch_that_never_had_gaussians_has_lost_none(trainer):
    trainer.scene.dynamic = Gaussians.empty(0, 1)
    assert require_branches((len(trainer.scene.static), 0), trainer.scene, trainer.views, trainer.config) is None
