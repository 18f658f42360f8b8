"""The scene at a time: static Gaussians with changing appearance, dynamic ones that deform (paper Eq. 5, 8, 11)."""

import subprocess
import sys

import pytest
import torch

from tests import plain
from tests.reference.covariance import covariance, rotation
from tests.scenes import as_gaussians, error, generator, make_camera, make_splats, relative_error
from warpgs.config import RenderSettings
from warpgs.model.scene import InTraining, SplitScene
from warpgs.model.splats import Splats
from warpgs.rendering import render

NUM_STATIC, NUM_DYNAMIC = 7, 5
TIME = torch.tensor([0.3])
LATER = torch.tensor([0.8])
GEOMETRY = ("means", "quats", "scales")


def model(**changes):
    return plain.model(position_bands=2, time_bands=2, depth=3, width=8, skip=1, sh_degree=3, **changes)


def make_scene(num_static=NUM_STATIC, num_dynamic=NUM_DYNAMIC, trained=True, **changes):
    """A scene; if ``trained``, with networks whose outputs are not 0."""
    static, dynamic = as_gaussians(make_splats(num_static, 1)), as_gaussians(make_splats(num_dynamic, 2))
    scene = SplitScene(static, dynamic, model(**changes), torch.zeros(3), torch.full((3,), 3.0))
    if trained:
        for network in (scene.deformation, scene.appearance):
            for parameter in network.trunk.layers(network.trunk.values.data)[-1]:
                parameter.copy_(0.2 * torch.randn(parameter.shape, generator=generator()))
    return scene


def named(splats):
    return {name: getattr(splats, name) for name in Splats.tensor_names() if name not in ("colors", "objects")}


def static_part(splats):
    return {name: t[:NUM_STATIC] for name, t in named(splats).items()}


def dynamic_part(splats):
    return {name: t[NUM_STATIC:] for name, t in named(splats).items()}


def differing(a, b):
    return {name for name in a if not torch.equal(a[name], b[name])}


def test_a_scene_is_its_static_followed_by_its_dynamic_gaussians():
    """Eq. 5 of the paper."""
    scene = make_scene()
    splats = scene.splats(TIME, use_deformation=False, use_appearance=False)
    for part, gaussians in ((static_part(splats), scene.static), (dynamic_part(splats), scene.dynamic)):
        assert torch.equal(part["means"], gaussians.means)
        assert torch.equal(part["quats"], gaussians.quats)
        assert error(part["scales"], gaussians.log_scales.exp()) < 1e-6
        assert error(part["opacities"], gaussians.logit_opacities.sigmoid()) < 1e-6
        assert torch.equal(part["sh"], gaussians.sh)


def test_is_dynamic_marks_the_branch_of_each_gaussian():
    assert make_scene().splats(TIME).is_dynamic.tolist() == [False] * NUM_STATIC + [True] * NUM_DYNAMIC


@pytest.mark.parametrize(("part", "changing"), [(static_part, {"sh", "opacities"}), (dynamic_part, set(GEOMETRY))])
def test_time_changes_the_appearance_of_static_gaussians_and_the_geometry_of_dynamic_ones(part, changing):
    scene = make_scene(appearance="all")
    assert differing(part(scene.splats(TIME)), part(scene.splats(LATER))) == changing


@pytest.mark.parametrize("sizes", [(0, 4), (4, 0), (0, 0), (1, 1)])
def test_either_branch_may_be_empty(sizes):
    splats = make_scene(*sizes).splats(TIME)
    assert len(splats.means) == sum(sizes)
    assert int(splats.is_dynamic.sum()) == sizes[1]


def test_the_sh_degree_is_passed_on():
    scene = make_scene()
    assert scene.splats(TIME, sh_degree=2).sh_degree == 2
    assert scene.static_splats(sh_degree=1).sh_degree == 1


def test_the_static_gaussians_alone_have_their_own_appearance():
    scene = make_scene()
    alone, whole = scene.static_splats(), static_part(scene.splats(TIME, use_appearance=False))
    for name in (*GEOMETRY, "opacities", "sh"):
        assert error(getattr(alone, name), whole[name]) < 1e-6


@pytest.mark.parametrize(("appearance", "bases"), [("color", 1), ("all", 16)])
def test_residuals_are_added_to_the_coefficients_of_the_lowest_degrees(appearance, bases):
    """Eq. 8 of the paper."""
    scene = make_scene(appearance=appearance)
    residual, _ = scene.appearance(scene.static.means, TIME)
    sh = static_part(scene.splats(TIME))["sh"].detach()
    assert residual.all()
    assert error(sh[:, :bases], scene.static.sh[:, :bases].double() + residual.double()) < 1e-6
    assert torch.equal(sh[:, bases:], scene.static.sh[:, bases:])


def test_residuals_of_opacity_are_added_to_its_logit():
    scene = make_scene(appearance="all")
    _, residual = scene.appearance(scene.static.means, TIME)
    logits = scene.static.logit_opacities.double() + residual.double()
    assert residual.all()
    assert error(static_part(scene.splats(TIME))["opacities"], 1.0 / (1.0 + torch.exp(-logits))) < 1e-6


def test_opacities_stay_within_zero_and_one_whatever_their_residuals():
    scene = make_scene(appearance="all")
    for bias in (-1e6, 1e6):
        scene.appearance.trunk.layers(scene.appearance.trunk.values.data)[-1].bias.fill_(bias)
        opacities = static_part(scene.splats(TIME))["opacities"]
        assert ((opacities >= 0) & (opacities <= 1)).all()


def test_opacities_are_constant_where_the_network_changes_colours_alone():
    splats = static_part(make_scene(appearance="color").splats(TIME))
    assert torch.equal(splats["opacities"], make_scene().static.opacities)


def test_the_appearance_network_gets_no_gradient_from_hidden_gaussians():
    scene, is_hidden = make_scene(appearance="all"), torch.arange(NUM_STATIC) < 3
    splats, _ = scene.splats_in_training(InTraining(is_hidden), TIME, True, True, None, None)
    assert not differing(static_part(splats), static_part(scene.splats(TIME)))
    weights = scene.appearance.trunk.values
    for changes in (splats.sh, splats.opacities):
        (hidden,) = torch.autograd.grad(changes[:3].square().sum(), weights, retain_graph=True)
        (others,) = torch.autograd.grad(changes[3:NUM_STATIC].square().sum(), weights, retain_graph=True)
        assert not hidden.any()
        assert others.any()


def test_without_use_appearance_the_appearance_network_does_not_matter():
    scene, plain = make_scene(appearance="all"), make_scene(trained=False)
    assert not differing(
        static_part(scene.splats(TIME, use_appearance=False)), static_part(plain.splats(TIME, use_appearance=False))
    )


@pytest.mark.parametrize("appearance", ["color", "all"])
def test_an_untrained_appearance_network_leaves_the_images_unchanged(appearance):
    scene = make_scene(trained=False, appearance=appearance)
    settings = RenderSettings(branches=True)
    before, after = (
        render(scene.splats(TIME, use_appearance=r), make_camera(), settings=settings) for r in (False, True)
    )
    for name in ("joint", "static", "dynamic"):
        assert torch.equal(getattr(before, name).image, getattr(after, name).image)
        assert getattr(before, name).alpha.any()


def test_positions_are_shifted_by_their_offsets():
    """Eq. 11 of the paper."""
    scene = make_scene()
    shift = scene.deformation(scene.dynamic.means, TIME)[:, :3]
    assert shift.all()
    expected = scene.dynamic.means.double() + shift.double()
    assert error(dynamic_part(scene.splats(TIME))["means"], expected) < 1e-6


def test_covariances_are_those_of_equation_11b():
    scene = make_scene()
    dynamic = scene.dynamic
    _, rotation_offset, scale_offset = scene.deformation(dynamic.means, TIME).double().split([3, 4, 3], 1)
    R = rotation(dynamic.quats.double())
    R_offset = rotation(rotation_offset + torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    A = R_offset @ R @ torch.diag_embed(scale_offset.exp()) @ R.mT
    before = covariance(dynamic.quats.double(), dynamic.log_scales.double().exp())
    deformed = dynamic_part(scene.splats(TIME))
    after = covariance(deformed["quats"].double(), deformed["scales"].double())
    assert relative_error(after, A @ before @ A.mT) < 1e-6
    assert relative_error(before, after) > 0.1


def test_an_untrained_deformation_network_leaves_dynamic_gaussians_unchanged():
    scene = make_scene(trained=False)
    assert not differing(dynamic_part(scene.splats(TIME)), dynamic_part(scene.splats(TIME, use_deformation=False)))


def test_without_use_deformation_time_does_not_matter_to_dynamic_gaussians():
    scene = make_scene()
    now, later = (scene.splats(time, use_deformation=False) for time in (TIME, LATER))
    assert not differing(dynamic_part(now), dynamic_part(later))


def test_noise_on_time_deforms_dynamic_gaussians_as_another_time_does():
    scene = make_scene()
    noisy, later = scene.splats(TIME, time_noise=LATER - TIME), scene.splats(LATER)
    for name in GEOMETRY:
        assert error(dynamic_part(noisy)[name], dynamic_part(later)[name]) < 1e-5


def test_noise_on_time_leaves_static_gaussians_unchanged():
    scene = make_scene(appearance="all")
    noisy, plain = scene.splats(TIME, time_noise=LATER - TIME), scene.splats(TIME)
    assert not differing(static_part(noisy), static_part(plain))


def test_no_gradient_flows_to_positions_through_the_networks():
    scene = make_scene(appearance="all")
    splats = scene.splats(TIME)
    values = [splats.quats, splats.scales, splats.opacities, splats.sh]
    sum(value.sum() for value in values).backward()
    assert not scene.static.means.grad.any()
    assert not scene.dynamic.means.grad.any()
    for network in (scene.deformation, scene.appearance):
        assert network.trunk.layers(network.trunk.values.grad)[0].weight.any()


def test_the_gradient_of_deformed_positions_is_that_of_canonical_positions():
    scene = make_scene()
    scene.splats(TIME).means.backward(torch.full((NUM_STATIC + NUM_DYNAMIC, 3), 2.0))
    assert (scene.static.means.grad == 2.0).all()
    assert (scene.dynamic.means.grad == 2.0).all()


def test_an_empty_scene_loads_the_state_of_another():
    scene = make_scene()
    other = SplitScene.empty(NUM_STATIC, NUM_DYNAMIC, model())
    other.load_state_dict(scene.state_dict())
    assert not differing(named(scene.splats(TIME)), named(other.splats(TIME)))


def test_the_appearance_network_has_the_size_of_both_networks_unless_it_has_its_own():
    assert make_scene().appearance.trunk.sizes[:-1] == make_scene().deformation.trunk.sizes[:-1]
    scene = make_scene(appearance_size=(2, 16))
    assert [rows for rows, _ in scene.appearance.trunk.sizes] == [16, 16, 3]
    assert [rows for rows, _ in scene.deformation.trunk.sizes] == [8, 8, 8, 10]


def test_a_scene_is_made_on_the_meta_device_without_the_compiler_of_torch():
    """Every run is opened by that; the compiler takes seconds to import, and 90 MB."""
    code = (
        "import sys, torch\n"
        "from warpgs.config import ModelConfig\n"
        "from warpgs.model.scene import SplitScene\n"
        "with torch.device('meta'):\n"
        "    SplitScene.empty(5, 4, ModelConfig())\n"
        "print('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"
