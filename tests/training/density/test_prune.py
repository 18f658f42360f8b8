"""Pruning by visibility (paper Eq. 15), and of the Gaussians that contribute least."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch

from tests import plain, tiny
from tests.reference.render import as_dict
from tests.reference.render import render as reference
from tests.scenes import as_gaussians, error, make_camera, make_splats, shifted
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.model.scene import SplitScene
from warpgs.runs.logger import TrainingLogger
from warpgs.training.density.prune import Pruned, blend_weights, prune_invisible, remove_weakest, visibility
from warpgs.training.optimizer import make_optimizer

NETWORK = plain.model(position_bands=1, time_bands=1, depth=1, width=2)
AHEAD = make_camera()
OPAQUE_LOGIT = 20.0
"""Logit of an opacity that rounds to 1 in single precision."""


def turned_around(camera):
    """The same camera with the opposite viewing direction."""
    return dataclasses.replace(camera, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ camera.viewmat)


CAMERAS = [AHEAD, shifted(AHEAD, 2.5, 0.4), shifted(AHEAD, -3.0, 0.7), turned_around(AHEAD)]


def in_front(depths, sizes, opacities):
    """Round Gaussians on the optical axis of ``AHEAD`` at some depths."""
    depths = torch.tensor(depths)
    viewed = torch.linalg.inv(AHEAD.K) @ torch.tensor([AHEAD.width / 2, AHEAD.height / 2, 1.0])
    points = (depths[:, None] * viewed - AHEAD.viewmat[:3, 3]) @ AHEAD.viewmat[:3, :3]
    gaussians = Gaussians.from_points(points, torch.rand(len(points), 3), torch.tensor(sizes), 0.5)
    gaussians.logit_opacities.data = torch.tensor(opacities).logit().clamp(max=OPAQUE_LOGIT)
    return gaussians


def random_gaussians():
    """Random positions; some Gaussians are outside all images, some are opaque."""
    gaussians = as_gaussians(make_splats())
    gaussians.logit_opacities.data[::7] = OPAQUE_LOGIT
    return gaussians


def make_scene(static, dynamic=None):
    return SplitScene(static, dynamic or Gaussians.empty(0), NETWORK, torch.zeros(3), torch.ones(3))


def make_scene_and_optimizer(static, dynamic=None):
    scene = make_scene(static, dynamic)
    return scene, make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.0))


def expected_visibility(gaussians, cameras):
    splats = as_dict(make_scene(gaussians).static_splats())
    alpha = splats["opacities"].detach()
    total = torch.zeros(len(gaussians), dtype=torch.float64)
    for camera in cameras:
        with torch.no_grad():
            _, _, weights = reference(splats, camera, torch.zeros(3, dtype=torch.float64))
        rendered = (weights > 0).any(2).any(1)
        total += torch.where(rendered, 1.0 - torch.where(alpha > 0.99, 0.99, alpha), 0.0)
    return total / len(cameras)


def test_visibility_is_that_of_equation_15_over_all_views():
    static = random_gaussians()
    expected = expected_visibility(static, CAMERAS)
    scores = visibility(make_scene(static), CAMERAS, 3)
    assert error(scores, expected) < 1e-6
    assert len(expected.unique()) > 20
    assert (expected == 0).any()


def test_an_opaque_gaussian_that_is_always_visible_scores_a_hundredth():
    scores = visibility(make_scene(in_front([2.0], [0.2], [1.0])), [AHEAD] * 3, 3)
    assert error(scores, torch.tensor([0.01])) < 1e-7


def test_a_gaussian_that_is_never_visible_scores_zero():
    scores = visibility(make_scene(in_front([-2.0, 2.0], [0.2, 0.2], [0.5, 0.5])), [AHEAD] * 2, 3)
    assert scores[0] == 0
    assert scores[1] > 0


def test_an_occluded_gaussian_scores_zero():
    hidden = in_front([2.0, 2.1, 5.0], [9.0, 9.0, 0.1], [1.0, 1.0, 0.5])
    free = in_front([5.0], [0.1], [0.5])
    assert visibility(make_scene(hidden), [AHEAD], 3)[2] == 0
    assert visibility(make_scene(free), [AHEAD], 3)[0] == 0.5


def test_dynamic_gaussians_do_not_occlude_static_ones():
    walls = in_front([2.0, 2.1], [9.0, 9.0], [1.0, 1.0])
    assert visibility(make_scene(in_front([5.0], [0.1], [0.5]), walls), [AHEAD], 3)[0] == 0.5


@pytest.mark.parametrize("unseen", [0, 1, 3])
def test_views_without_the_gaussian_count_in_the_mean(unseen):
    cameras = [AHEAD] + [turned_around(AHEAD)] * unseen
    scores = visibility(make_scene(in_front([2.0], [0.2], [0.25])), cameras, 3)
    assert error(scores, torch.tensor([0.75 / (1 + unseen)])) < 1e-6


def test_visibility_does_not_depend_on_the_order_of_the_views_which_may_be_an_iterator():
    scene = make_scene(random_gaussians())
    expected = visibility(scene, CAMERAS, 3)
    assert torch.equal(visibility(scene, iter(CAMERAS), 3), expected)
    assert error(visibility(scene, CAMERAS[::-1], 3), expected) < 1e-7


def test_visibility_requires_no_gradients():
    assert not visibility(make_scene(random_gaussians()), [AHEAD], 3).requires_grad


def test_pruning_keeps_gaussians_at_or_above_the_threshold_in_order():
    static = random_gaussians()
    scores = expected_visibility(static, CAMERAS)
    middle = 0.5 * scores.sort().values[29:31].sum().item()  # between two scores: half of the sixty are below
    kept = scores > middle
    before = {name: getattr(static, name).detach().clone() for name in PARAMETERS}
    scene, optimizer = make_scene_and_optimizer(static)
    assert sum(prune_invisible(scene, optimizer, CAMERAS, 3, middle)) == int((~kept).sum())
    for name in PARAMETERS:
        assert torch.equal(getattr(scene.static, name), before[name][kept])


def test_what_is_removed_is_counted_by_kind():
    """One camera of four sees the Gaussians in front; 0.25 · (1 − α) is below 0.2 if α exceeds 0.2."""
    static = in_front([-2.0, 2.0, 2.5, 3.0, 3.5], [0.1] * 5, [0.5, 0.95, 0.92, 0.4, 0.1])
    static.means.data[1:] += (
        torch.tensor([[-0.9, 0, 0], [-0.3, 0, 0], [0.3, 0, 0], [0.9, 0, 0]]) @ AHEAD.viewmat[:3, :3]
    )
    scene, optimizer = make_scene_and_optimizer(static)
    removed = prune_invisible(scene, optimizer, [AHEAD] + [shifted(AHEAD, 100.0, 0.0)] * 3, 3, 0.2)
    assert removed == Pruned(unseen=1, opaque=2, faint=1)
    assert error(scene.static.opacities, torch.tensor([0.1])) < 1e-6
    assert str(removed) == (
        "4 static Gaussians pruned by visibility: 1 that no frame shows, 2 opaque and 1 other that few show"
    )


def test_a_score_equal_to_the_threshold_is_kept():
    scene, optimizer = make_scene_and_optimizer(in_front([2.0], [0.2], [0.5]))
    assert sum(prune_invisible(scene, optimizer, [AHEAD], 3, threshold=0.5)) == 0
    assert len(scene.static) == 1


def test_a_threshold_of_zero_removes_nothing():
    scene, optimizer = make_scene_and_optimizer(random_gaussians())
    assert sum(prune_invisible(scene, optimizer, [turned_around(AHEAD)], 3, threshold=0.0)) == 0
    assert len(scene.static) == 60


def test_dynamic_gaussians_are_never_pruned():
    scene, optimizer = make_scene_and_optimizer(random_gaussians(), random_gaussians())
    before = scene.dynamic.means.detach().clone()
    assert sum(prune_invisible(scene, optimizer, [turned_around(AHEAD)], 3, threshold=2.0)) == 60
    assert len(scene.static) == 0
    assert torch.equal(scene.dynamic.means, before)


def test_kept_gaussians_keep_their_optimizer_state():
    scene, optimizer = make_scene_and_optimizer(in_front([2.0, -2.0, 3.0], [0.1] * 3, [0.5] * 3))
    for parameter in scene.parameters():
        parameter.grad = torch.zeros_like(parameter)
    scene.static.logit_opacities.grad = torch.tensor([1.0, 2.0, 3.0])
    optimizer.step()
    before = optimizer.state[scene.static.logit_opacities]["exp_avg"].clone()
    assert sum(prune_invisible(scene, optimizer, [AHEAD], 3, threshold=1e-3)) == 1
    assert before.unique().numel() == 3
    assert torch.equal(optimizer.state[scene.static.logit_opacities]["exp_avg"], before[[0, 2]])


def test_a_scene_without_static_gaussians_has_nothing_to_prune():
    scene, optimizer = make_scene_and_optimizer(Gaussians.empty(0), random_gaussians())
    assert visibility(scene, CAMERAS, 3).shape == (0,)
    assert sum(prune_invisible(scene, optimizer, CAMERAS, 3, threshold=0.1)) == 0


def test_blend_weights_are_summed_over_the_joint_images_of_all_views(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    trainer._add_dynamic_gaussians()
    scene, views = trainer.scene, trainer.views
    expected = torch.zeros(len(scene.static) + len(scene.dynamic), dtype=torch.float64)
    for view in map(views.__getitem__, range(len(views))):
        with torch.no_grad():
            splats = as_dict(scene.splats(view.time, sh_degree=1))
            expected += reference(splats, view.camera, torch.zeros(3, dtype=torch.float64))[2].sum((1, 2))
    assert error(blend_weights(scene, views, plain.phase(stage="stage2")), expected) < 1e-5 * expected.max()
    assert (expected > 0).sum() > len(expected) / 2


def test_the_weakest_are_those_that_together_hold_the_fraction():
    scene, optimizer = make_scene_and_optimizer(random_gaussians(), in_front([2.0] * 4, [0.1] * 4, [0.5] * 4))
    weights = torch.full((64,), 2.0)
    weights[[3, 7, 61]] = torch.tensor([1.0, 0.5, 0.0])
    before = scene.static.means.detach().clone(), scene.dynamic.means.detach().clone()
    fraction = 1.6 / weights.sum().item()  # 0 + 0.5 + 1.0 fit, 2.0 more do not
    assert remove_weakest(scene, optimizer, weights, fraction) == 3
    kept = [index for index in range(60) if index not in (3, 7)]
    assert torch.equal(scene.static.means, before[0][kept])
    assert torch.equal(scene.dynamic.means, before[1][[0, 2, 3]])


def test_a_fraction_of_zero_removes_what_contributes_nothing():
    scene, optimizer = make_scene_and_optimizer(random_gaussians())
    weights = torch.ones(60)
    weights[5] = 0.0
    assert remove_weakest(scene, optimizer, weights, 0.0) == 1
    assert len(scene.static) == 59


def test_if_no_gaussian_contributes_all_stay():
    scene, optimizer = make_scene_and_optimizer(random_gaussians())
    assert remove_weakest(scene, optimizer, torch.zeros(60), 0.02) == 0
    assert len(scene.static) == 60


@pytest.mark.parametrize(("removed", "lines"), [(Pruned(0, 0, 0), 0), (Pruned(1, 0, 0), 1)])
def test_only_a_pruning_that_removes_something_is_logged(data, tmp_path, monkeypatch, removed, lines):
    trainer = tiny.trainer(data, tmp_path)
    monkeypatch.setattr("warpgs.training.density.prune.prune_invisible", lambda *_: removed)
    logger = Mock(spec=TrainingLogger)
    trainer._adapt(tiny.plan_to(trainer, "prune"), logger)
    assert logger.log.call_count == lines
