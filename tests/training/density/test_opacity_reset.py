"""Resets of opacities: as the training views show them."""

import copy
import dataclasses
from unittest.mock import Mock

import pytest
import torch
from torch import nn

from tests import plain, tiny
from tests.reference.projection import project as reference
from tests.scenes import along_z, error, generator, relative_error
from tests.training.density import sets
from warpgs.config import RenderSettings
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.ops.projection import Geometry, View
from warpgs.rendering import opacities_on_screen, render
from warpgs.runs.logger import TrainingLogger
from warpgs.training.density.opacity_reset import reset_opacities

PHASE = plain.phase(use_appearance=False, sh_degree=0)
ANTIALIAS = RenderSettings(antialias=True)
FOCAL, DEPTH, SIZE = 100.0, 2.0, (96, 80)
STDS = torch.linspace(0.1, 2.0, 20)
"""Standard deviations on screen in the nearest view [px]."""


NEAR, FAR, ASIDE = (
    along_z(FOCAL, SIZE, position, time)
    for position, time in (((0.0, 0.0, 0.0), 0.0), ((0.0, 0.0, -1.5), 0.5), ((0.8, 0.0, 0.0), 1.0))
)
"""The last one shows a part of the Gaussians."""

CAMERAS = [NEAR, FAR, ASIDE]
AWAY = dataclasses.replace(NEAR, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])))


class Receding(nn.Module):
    """Moves dynamic Gaussians away from ``NEAR`` as time passes."""

    def forward(self, means, time):
        offsets = means.new_zeros(len(means), 10)
        offsets[:, 2] = 2.0 * time
        return offsets


def make_gaussians(seed, stds):
    """Round Gaussians that do not overlap, with any opacities."""
    g, num = generator(seed), len(stds)
    cells = torch.stack([torch.arange(num) % 8, torch.arange(num) // 8], 1) * torch.tensor([11.0, 12.0])
    pixels = 4.0 + cells + torch.tensor([0.0, 36.0]) * (seed % 2) + 4.0 * torch.rand(num, 2, generator=g)
    means = torch.cat([(pixels - torch.tensor(SIZE) / 2) * DEPTH / FOCAL, torch.full((num, 1), DEPTH)], 1)
    gaussians = Gaussians.from_points(means, torch.rand(num, 3, generator=g), stds * DEPTH / FOCAL, 0.5)
    gaussians.logit_opacities.data = torch.rand(num, generator=g).mul(0.95).add(0.005).logit()
    return gaussians


def make_scene(stds=(STDS, STDS)):
    """A scene, and its optimizer after one step at rate 0 that left every moment at 1 or more."""
    scene, optimizer = sets.make_scene(*(make_gaussians(*pair) for pair in enumerate(stds)))
    scene.deformation = Receding()
    scene.zero_grad()
    return scene, optimizer


def splats_in(scene, camera, phase=PHASE):
    return scene.splats(torch.tensor([camera.time]), phase.use_deformation, use_appearance=False)


def logits(scene):
    return torch.cat([scene.static.logit_opacities, scene.dynamic.logit_opacities]).detach()


def with_gradient(scene, camera, settings):
    """Which Gaussians get a gradient of the opacity in a view."""
    image = render(splats_in(scene, camera), camera, settings=settings).joint.image
    (image * torch.randn(image.shape, generator=generator())).sum().backward()
    gradients = torch.cat([scene.static.logit_opacities.grad, scene.dynamic.logit_opacities.grad])
    scene.zero_grad()
    return gradients != 0


@pytest.mark.parametrize("antialias", [False, True])
def test_a_reset_leaves_every_visible_splat_a_gradient(antialias):
    (scene, optimizer), settings = make_scene(), RenderSettings(antialias=antialias)
    before = [with_gradient(scene, camera, settings) for camera in CAMERAS]
    reset_opacities(scene, optimizer, CAMERAS, PHASE, settings)
    for camera, had_gradient in zip(CAMERAS, before, strict=True):
        is_inside = camera.project(splats_in(scene, camera).means)[3]  # elsewhere a part of the splat alone was visible
        assert (had_gradient & is_inside).sum() > 10
        assert with_gradient(scene, camera, settings)[had_gradient & is_inside].all()


@pytest.mark.parametrize("use_deformation", [True, False])
def test_the_view_that_shows_a_gaussian_faintest_shows_a_hundredth_after_a_reset(use_deformation):
    (scene, optimizer), phase = make_scene(), dataclasses.replace(PHASE, use_deformation=use_deformation)
    opacities, smallest = logits(scene).double().sigmoid(), torch.ones(40).double()
    for camera in CAMERAS:
        splats = splats_in(scene, camera, phase)
        geometry = Geometry(*(t.detach().double() for t in (splats.means, splats.quats, splats.scales)), opacities)
        view = View(camera.viewmat.double(), camera.K.double(), *SIZE)
        *_, on_screen, visible = reference(geometry, view, antialias=True)
        smallest = torch.where(visible, (on_screen / opacities).minimum(smallest), smallest)
    reset_opacities(scene, optimizer, CAMERAS, phase, ANTIALIAS)
    expected = (0.01 / smallest).minimum(opacities)
    assert relative_error(logits(scene).sigmoid(), expected) < 1e-5
    assert 10 < (expected < opacities).sum() < 40


def test_no_view_shows_less_than_a_hundredth_of_a_splat_that_it_showed_unless_it_did_before():
    scene, optimizer = make_scene()
    before = [opacities_on_screen(splats_in(scene, camera), camera, ANTIALIAS) for camera in CAMERAS]
    reset_opacities(scene, optimizer, CAMERAS, PHASE, ANTIALIAS)
    after = [opacities_on_screen(splats_in(scene, camera), camera, ANTIALIAS) for camera in CAMERAS]
    for least, found in zip(before, after, strict=True):
        assert (found >= 0.9999 * least.clamp(max=0.01)).all()


@pytest.mark.parametrize("cameras", [CAMERAS, []])
def test_without_antialias_a_reset_clamps_opacities_to_a_hundredth(cameras):
    scene, optimizer = make_scene()
    before = logits(scene)
    reset_opacities(scene, optimizer, cameras, PHASE, RenderSettings())
    assert torch.equal(logits(scene), before.clamp(max=torch.logit(torch.tensor(0.01)).item()))


@pytest.mark.parametrize("cameras", [[AWAY], []])
def test_gaussians_that_no_view_shows_are_reset_to_a_hundredth(cameras):
    scene, optimizer = make_scene()
    before = logits(scene).sigmoid()
    reset_opacities(scene, optimizer, cameras, PHASE, ANTIALIAS)
    assert error(logits(scene).sigmoid(), before.clamp(max=0.01)) < 1e-7


def test_the_order_of_the_views_does_not_change_a_reset():
    (first, optimizer), (second, other) = make_scene(), make_scene()
    reset_opacities(first, optimizer, CAMERAS, PHASE, ANTIALIAS)
    reset_opacities(second, other, iter(CAMERAS[::-1]), PHASE, ANTIALIAS)
    assert torch.equal(logits(first), logits(second))


@pytest.mark.parametrize("settings", [RenderSettings(), ANTIALIAS])
def test_a_reset_changes_opacities_and_clears_their_moments_only(settings):
    scene, optimizer = make_scene()
    before = {name: parameter.detach().clone() for name, parameter in scene.named_parameters()}
    reset_opacities(scene, optimizer, CAMERAS, PHASE, settings)
    for branch in ("static", "dynamic"):
        for name in PARAMETERS:
            parameter = getattr(getattr(scene, branch), name)
            assert torch.equal(parameter, before[f"{branch}.{name}"]) == (name != "logit_opacities")
            for part in ("exp_avg", "exp_avg_sq"):
                assert optimizer.state[parameter][part].any() == (name != "logit_opacities")


@pytest.mark.parametrize("sizes", [(0, 0), (0, 1), (20, 0)])
def test_branches_may_be_empty(sizes):
    scene, optimizer = make_scene([STDS[:num] for num in sizes])
    reset_opacities(scene, optimizer, CAMERAS, PHASE, ANTIALIAS)
    assert [len(scene.static), len(scene.dynamic)] == list(sizes)
    assert logits(scene).isfinite().all()


def test_training_resets_opacities_as_its_own_views_show_them(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path, dataclasses.replace(tiny.CONFIG, antialias=True))
    trainer._add_dynamic_gaussians()
    phase = trainer.protocol.at(trainer.protocol.stage2.start).phase
    reset = {}
    for settings in (RenderSettings(), trainer.config.render_settings):
        reset[settings.antialias] = copy.deepcopy(trainer.scene)
        reset_opacities(reset[settings.antialias], trainer.step.optimizer, trainer.views.cameras(), phase, settings)
    trainer._adapt(dataclasses.replace(tiny.plan_to(trainer, "reset"), phase=phase), Mock(spec=TrainingLogger))
    assert torch.equal(logits(trainer.scene), logits(reset[True]))
    assert not torch.equal(logits(trainer.scene), logits(reset[False]))
