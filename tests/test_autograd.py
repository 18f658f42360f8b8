"""A render as an autograd node: repeated backward passes, in-place changes, freed memory."""

import dataclasses
import gc
import weakref
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from tests.scenes import as_leaves, float_tensors, gradients, make_camera, make_splats
from warpgs import rendering
from warpgs.config import RenderSettings
from warpgs.ops import projection
from warpgs.ops.mlp import perceptron
from warpgs.rendering import render

CAMERA = make_camera()


def test_a_second_derivative_is_an_error_not_zero():
    splats = as_leaves(make_splats())
    loss = render(splats, CAMERA).joint.image.square().sum()
    (first,) = torch.autograd.grad(loss, [splats.means], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        first.sum().backward()


def test_a_second_derivative_of_the_perceptron_is_an_error_not_zero():
    inputs, values = torch.rand(5, 4), torch.rand(5 * 8).requires_grad_()
    (first,) = torch.autograd.grad(
        perceptron(inputs, values, [(8, 4)], 0, (8,))[0].square().sum(), values, create_graph=True
    )
    with pytest.raises(RuntimeError, match="differentiate twice"):
        first.sum().backward()


def test_a_second_backward_pass_adds_the_same_gradients():
    splats = as_leaves(make_splats())
    loss = render(splats, CAMERA).joint.image.square().sum()
    loss.backward(retain_graph=True)
    once = {name: g.clone() for name, g in gradients(splats).items()}
    loss.backward()
    for name, gradient in gradients(splats).items():
        assert torch.equal(gradient, 2 * once[name])


def test_two_threads_may_run_the_backward_pass_of_one_render_at_once():
    splats = as_leaves(make_splats(200))
    image = render(splats, make_camera()).joint.image
    parameters = (splats.means, splats.opacities)
    v_images = [torch.rand_like(image) for _ in range(2)]

    def passes(v_image, count=50):
        return [torch.autograd.grad(image, parameters, v_image, retain_graph=True) for _ in range(count)]

    expected = [passes(v_image, 1)[0] for v_image in v_images]
    with ThreadPoolExecutor(2) as threads:
        for results, wanted in zip(threads.map(passes, v_images), expected, strict=True):
            for actual in results:
                assert all(torch.allclose(a, w, rtol=1e-4, atol=1e-7) for a, w in zip(actual, wanted, strict=True))


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh"])
def test_a_parameter_changed_in_place_before_the_backward_pass_is_an_error(name):
    splats = as_leaves(make_splats())
    loss = render(splats, CAMERA).joint.image.sum()
    with torch.no_grad():
        getattr(splats, name).add_(0.01)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def render_layers(splats, background):
    rendering = render(splats, CAMERA, background, RenderSettings(depth=True, branches=True))
    return {"radii": rendering.radii, **rendering.dynamic._asdict()}


@pytest.mark.parametrize("name", ["depth", "alpha"])
def test_an_output_that_the_backward_pass_reads_must_not_be_changed_before(name):
    splats, background = as_leaves(make_splats()), torch.zeros(3, requires_grad=True)
    layers = render_layers(splats, background)
    loss = layers["image"].sum() + layers["depth"].sum()
    with torch.no_grad():
        layers[name].mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.parametrize("name", ["image", "alpha"])
def test_other_outputs_may_be_changed_and_gradients_are_correct(name):
    found = []
    for multiply in (torch.mul, torch.Tensor.mul_):
        splats = as_leaves(make_splats())
        multiply(render_layers(splats, torch.zeros(3))[name], 2).square().sum().backward()
        found.append(splats.means.grad)
    assert torch.equal(*found)


@pytest.mark.parametrize("harmonics", [False, True])
def test_radii_may_be_changed_and_gradients_are_correct(harmonics):
    found = []
    for change in (torch.Tensor.clone, torch.Tensor.zero_):
        splats = as_leaves(make_splats() if harmonics else make_splats(channels=3))
        rendering = render(splats, CAMERA)
        change(rendering.radii)
        rendering.joint.image.square().sum().backward()
        found.append(splats.means.grad)
    assert torch.equal(*found)


@pytest.mark.parametrize("name", ["colors", "screen_offsets"])
def test_inputs_that_the_backward_pass_does_not_read_may_be_changed(name):
    found, colors = [], torch.rand(len(make_splats().means), 3)
    for change in (False, True):
        splats = as_leaves(dataclasses.replace(make_splats(), sh=None, colors=colors))
        offsets = torch.zeros(len(colors), 2, requires_grad=True)
        rendering = render(splats, CAMERA, screen_offsets=offsets)
        with torch.no_grad():
            {"colors": splats.colors, "screen_offsets": offsets}[name].mul_(2).add_(int(change))
        rendering.joint.image.square().sum().backward()
        found.append((splats.means.grad, splats.colors.grad, offsets.grad))
    for plain, changed in zip(*found, strict=True):
        assert torch.equal(plain, changed)


def test_gradients_continue_to_the_inputs_of_the_parameters():
    splats = make_splats()
    raw = splats.scales.log().requires_grad_()
    leaf = as_leaves(splats)
    render(leaf, CAMERA).joint.image.sum().backward()
    through = type(splats)(splats.means, splats.quats, raw.exp(), splats.opacities, sh=splats.sh)
    render(through, CAMERA).joint.image.sum().backward()
    assert (raw.grad - leaf.scales.grad * leaf.scales.detach()).norm() <= 1e-5 * raw.grad.norm()


@pytest.mark.parametrize("name_with_gradient", ["means", "quats", "scales", "opacities", "sh"])
def test_gradients_flow_only_to_tensors_that_require_them(name_with_gradient):
    everything, one = as_leaves(make_splats()), as_leaves(make_splats())
    for name, tensor in float_tensors(one).items():
        tensor.requires_grad_(name == name_with_gradient)
    for splats in (everything, one):
        render(splats, make_camera()).joint.image.sum().backward()
    for name, gradient in gradients(one).items():
        if name == name_with_gradient:
            assert torch.equal(gradient, gradients(everything)[name])
        else:
            assert gradient is None


def test_without_inputs_that_require_gradients_nothing_is_recorded():
    assert not render(make_splats(), make_camera()).joint.image.requires_grad


@pytest.mark.parametrize("use_reentrant", [False, True])
def test_a_checkpointed_render_has_the_same_gradients(use_reentrant):
    settings = RenderSettings(branches=True, depth=True, absgrad=True)

    def loss(means, sh, background, offsets):
        splats = dataclasses.replace(make_splats(), means=means, sh=sh)
        rendering = render(splats, CAMERA, background, settings, offsets)
        return rendering.joint.image.square().sum() + rendering.dynamic.depth.sum()

    found = []
    for checkpointed in (False, True):
        splats = as_leaves(make_splats())
        inputs = (splats.means, splats.sh, torch.full((3,), 0.5).requires_grad_(), torch.zeros(60, 2).requires_grad_())
        value = checkpoint(loss, *inputs, use_reentrant=use_reentrant) if checkpointed else loss(*inputs)
        value.backward()
        found.append([t.grad for t in inputs])
    for expected, actual in zip(*found, strict=True):
        assert expected.any()
        assert torch.equal(actual, expected)


@pytest.fixture
def backward_passes(monkeypatch):
    """Weak references to what every render keeps for its backward pass, while only reference counts free memory."""
    references = []
    make = rendering._Backward.__init__

    def made(self, *args):
        references.append(weakref.ref(self))
        make(self, *args)

    monkeypatch.setattr(rendering._Backward, "__init__", made)
    gc.collect()
    gc.disable()
    yield references
    gc.enable()


@pytest.mark.parametrize("backward", [False, True])
def test_a_render_is_freed_with_its_images(backward_passes, backward):
    splats = as_leaves(make_splats())
    for _ in range(3):
        image = render(splats, CAMERA, torch.zeros(3, requires_grad=True), RenderSettings(depth=True)).joint.image
        if backward:
            image.sum().backward()
        freed = weakref.ref(image)
        del image
        assert freed() is None
    assert len(backward_passes) == 3
    assert [reference() for reference in backward_passes] == [None] * 3


def test_a_render_whose_backward_pass_fails_is_freed(monkeypatch):
    def fail(*args):
        raise MemoryError

    monkeypatch.setattr(rendering, "project_bwd", fail)
    background = torch.zeros(3, requires_grad=True)
    rendered = render(as_leaves(make_splats()), CAMERA, background, RenderSettings(depth=True))
    node = weakref.ref(rendered.joint.image.grad_fn)
    with pytest.raises(MemoryError):
        rendered.joint.image.sum().backward()
    del rendered
    gc.collect()  # of the exception and its frames
    assert node() is None


def test_a_render_without_gradients_is_freed_at_once(backward_passes):
    with torch.no_grad():
        render(make_splats(), CAMERA)
    assert [reference() for reference in backward_passes] == [None]


def test_a_checkpointed_render_keeps_nothing_of_its_gaussians(monkeypatch):
    kept = []

    def project(*args):
        rows, *rest = projection.project_fwd(*args)
        kept.append(weakref.ref(rows.packed))
        return rows, *rest

    monkeypatch.setattr(rendering, "project_fwd", project)
    splats = as_leaves(make_splats())
    image = checkpoint(lambda means: render(splats, CAMERA).joint.image, splats.means, use_reentrant=False)
    assert [reference() for reference in kept] == [None]
    image.sum().backward()
    assert len(kept) == 2
