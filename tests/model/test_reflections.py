"""Colour of dynamic Gaussians from the light that they reflect."""

import dataclasses

import pytest
import torch
from torch.func import functional_call

from tests import plain, tiny
from tests.reference.covariance import rotation
from tests.scenes import as_gaussians, error, generator, make_camera, make_splats
from warpgs.export.export_run import REFLECTIONS_NOTE, export_run
from warpgs.export.options import Export
from warpgs.model.reflections import Light, Reflections, reflections
from warpgs.model.scene import SplitScene
from warpgs.rendering import render
from warpgs.runs.run import Run

NUM_STATIC, NUM_DYNAMIC = 7, 5
TIME = torch.tensor([0.3])
CONFIG = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, reflections=True))
MODEL = plain.model(position_bands=2, time_bands=2, depth=3, width=8, skip=1, sh_degree=3, reflections=True)


def make_scene(trained=True, num_dynamic=NUM_DYNAMIC, model=MODEL):
    """A scene; if ``trained``, with light and reflectances that are not 0."""
    static, dynamic = as_gaussians(make_splats(NUM_STATIC, 1)), as_gaussians(make_splats(num_dynamic, 2))
    scene = SplitScene(static, dynamic, model, torch.zeros(3), torch.full((3,), 3.0))
    if trained:
        g = generator()
        for parameter in (*scene.light.parameters(), scene.dynamic.reflectances):
            parameter.data.copy_(0.2 * torch.randn(parameter.shape, generator=g))
        for parameter in scene.deformation.trunk.layers(scene.deformation.trunk.values.data)[-1]:
            parameter.copy_(0.2 * torch.randn(parameter.shape, generator=g))
    return scene


class Directions(Light):
    """A light whose colour is the direction of the normal, or of the reflected ray."""

    def __init__(self, mirrors):
        super().__init__(torch.zeros(1))
        self.mirrors = mirrors

    def forward(self, d, n, material):
        return d - 2.0 * (d * n).sum(1, keepdim=True) * n if self.mirrors else n


def colors(light, normals, means, viewmat=None):
    return Reflections(light, normals, torch.zeros(len(means), 1)).colors(
        means, torch.eye(4) if viewmat is None else viewmat
    )


def test_a_mirror_reflects_by_the_angle_of_incidence():
    half = 0.5**0.5
    normals, means = (
        torch.tensor([[0.0, half, -half], [0.0, 0.0, 1.0]]),
        torch.tensor([[0.0, 0.0, 2.0], [3.0, 0.0, 4.0]]),
    )
    expected = torch.tensor([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8]])
    assert error(colors(Directions(True), normals, means), expected) < 1e-6


def test_normals_point_towards_the_camera():
    normals, means = torch.tensor([[0.0, 0.6, 0.8], [0.0, 0.6, -0.8]]), torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 2.0]])
    assert error(colors(Directions(False), normals, means), torch.tensor([[0.0, -0.6, -0.8], [0.0, 0.6, -0.8]])) < 1e-6


def test_reflected_directions_are_in_world_axes():
    camera = make_camera()
    viewpoint = torch.linalg.inv(camera.viewmat)[:3, 3]
    normals = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator()), dim=1)
    means = torch.randn(6, 3, generator=generator())
    d = torch.nn.functional.normalize(means - viewpoint, dim=1)
    expected = d - 2.0 * (d * normals).sum(1, keepdim=True) * normals
    assert error(colors(Directions(True), normals, means, camera.viewmat), expected) < 1e-5


def test_the_normal_is_the_shortest_axis_at_rest_turned_with_the_gaussian():
    quats, log_scales = (
        torch.randn(4, 4, generator=generator()),
        torch.tensor([[0.0, -2, -1], [-2, 0, 0], [3, 2, 1], [0, 0, -1]]),
    )
    expected = rotation(quats.double()).mT[torch.arange(4), torch.tensor([1, 0, 2, 2])]
    light = Light(torch.zeros(1))
    assert error(reflections(light, log_scales, quats, torch.zeros(4, light.size)).normals, expected) < 1e-6


def test_a_correction_turns_the_normal_in_the_axes_of_the_gaussian():
    quats, log_scales = torch.randn(3, 4, generator=generator()), torch.tensor([0.0, 0.0, -1.0]).repeat(3, 1)
    light = Light(torch.zeros(1))
    reflectances = torch.zeros(3, light.size)
    reflectances[:, 0] = 0.75
    expected = rotation(quats.double()) @ torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    assert error(reflections(light, log_scales, quats, reflectances).normals, expected) < 1e-6


class Seen(torch.nn.Module):
    """Colours of Gaussians as a function of the parameters of the light, too."""

    def __init__(self, light):
        super().__init__()
        self.light = light

    def forward(self, log_scales, means, quats, reflectances, viewmat):
        return reflections(self.light, log_scales, quats, reflectances).colors(means, viewmat)


def test_gradients_agree_with_finite_differences(contracts_off):
    g = generator()
    light = Light(torch.zeros(1, dtype=torch.float64))
    module = Seen(light)
    for parameter in light.parameters():
        parameter.data.copy_(0.3 * torch.randn(parameter.shape, generator=g))
    log_scales = torch.randn(4, 3, dtype=torch.float64, generator=g)
    shapes = ((4, 3), (4, 4), (4, light.size), (4, 4))
    means, quats, reflectances, viewmat = (torch.randn(s, dtype=torch.float64, generator=g) for s in shapes)

    def of(means, quats, reflectances, viewmat, *parameters):
        state = dict(zip(dict(module.named_parameters()), parameters, strict=True))
        return functional_call(module, state, (log_scales, means, quats, reflectances, viewmat))

    inputs = [t.detach().requires_grad_() for t in (means, quats, reflectances, viewmat, *light.parameters())]
    assert torch.autograd.gradcheck(of, inputs, eps=1e-6, atol=1e-5, nondet_tol=0.0, fast_mode=True)


def test_untrained_light_leaves_the_images_unchanged():
    camera, without = make_camera(), dataclasses.replace(MODEL, reflections=False)
    images = [render(make_scene(trained=False, model=m).splats(TIME), camera).joint.image for m in (MODEL, without)]
    assert images[0].any()
    assert torch.equal(*images)


def test_reflections_change_dynamic_gaussians_alone():
    splats = make_scene().splats(TIME)
    seen, plainly = splats.seen_from(make_camera().viewmat), dataclasses.replace(splats, reflections=None)
    assert torch.equal(seen.sh[:NUM_STATIC], plainly.sh[:NUM_STATIC])
    assert torch.equal(seen.sh[:, 1:], plainly.sh[:, 1:])
    assert (seen.sh[NUM_STATIC:, 0] != plainly.sh[NUM_STATIC:, 0]).all()


def test_gradients_arrive_through_the_image():
    scene = make_scene()
    render(scene.splats(TIME), make_camera()).joint.image.square().sum().backward()
    for name, parameter in (*scene.light.named_parameters(), ("reflectances", scene.dynamic.reflectances)):
        assert parameter.grad.any(), name


def test_reflections_begin_with_the_highest_degree_of_harmonics():
    scene = make_scene()
    assert [scene.splats(TIME, sh_degree=k).reflections is not None for k in (2, 3, None)] == [False, True, True]


def test_no_gaussian_reflects_nothing():
    splats = make_scene(num_dynamic=0).splats(TIME)
    assert splats.seen_from(make_camera().viewmat).sh.shape == (NUM_STATIC, 16, 3)


def test_a_gaussian_at_the_viewpoint_has_a_finite_colour():
    light = make_scene().light
    found = reflections(light, torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, light.size))
    assert found.colors(torch.zeros(1, 3), torch.eye(4)).isfinite().all()


def test_an_empty_scene_loads_the_state_of_another():
    scene, other = make_scene(), SplitScene.empty(NUM_STATIC, NUM_DYNAMIC, MODEL)
    other.load_state_dict(scene.state_dict())
    a, b = (s.splats(TIME).seen_from(make_camera().viewmat).sh for s in (scene, other))
    assert torch.equal(a, b)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder, trained once, which tests leave as it is."""
    return tiny.finished(tmp_path_factory.mktemp("reflecting"), CONFIG)


@pytest.mark.usefixtures("quickly")
@pytest.mark.parametrize("stop", [9, 18])
def test_a_resumed_run_with_reflections_is_bit_identical(run, tmp_path, stop):
    data = Run.open(run, "cpu").config.data
    first = tiny.trainer(data, tmp_path / "run", CONFIG)
    assert not tiny.train(first, tiny.StopWhen(lambda: first.iteration >= stop))
    second = tiny.trainer(data, tmp_path / "run", CONFIG)
    second.restore_newest(print)
    assert tiny.train(second)
    assert tiny.differences(tiny.state(tmp_path / "run"), tiny.state(run)) == []


def test_training_changes_the_light_and_every_material(run):
    state = tiny.state(run)
    assert state["scene.dynamic.reflectances"].any(0).all()
    assert all(value.any() for name, value in state.items() if name.startswith("scene.light."))


def test_an_opened_run_shows_reflections(run):
    opened = Run.open(run, "cpu")
    capture = opened.open_capture(quiet=True)
    camera = capture.cameras[capture.train[0]]
    scene = opened.trained_scene()
    plainly = dataclasses.replace(scene.splats(camera.time), reflections=None)
    settings = scene.config.render_settings
    image = scene.render(camera).joint.image
    assert not torch.equal(image, render(plainly, camera, settings=settings).joint.image)
    assert torch.equal(scene.play(camera), image)


@pytest.mark.parametrize("format", ["ply", "html"])
def test_exports_say_that_they_omit_reflections(run, finished_run, tmp_path, format):
    def summary(folder):
        return export_run(Export(folder, format=format, out=tmp_path, quiet=True))

    assert summary(run).splitlines()[-1] == REFLECTIONS_NOTE
    assert "reflections" not in summary(finished_run)
