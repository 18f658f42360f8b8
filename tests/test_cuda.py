"""Renders and losses on the GPU equal those on the CPU."""

import dataclasses
import gc
import weakref

import pytest
import torch

from tests.reference.depth_error import random_inputs
from tests.scenes import (
    as_leaves,
    generator,
    gradients,
    make_camera,
    make_splats,
    random_like,
    relative_error,
    weighted_sum,
)
from warpgs.config import RenderSettings
from warpgs.ops.depth_error import depth_error
from warpgs.ops.ssim import l1_and_ssim, ssim_map
from warpgs.ops.tiles import reset_budgets
from warpgs.rendering import render
from warpgs.runtime import replay
from warpgs.runtime.replay import EAGER_CALLS

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
SETTINGS = [
    RenderSettings(),
    RenderSettings(branches=True, statistics=True, absgrad=True),
    RenderSettings(depth=True, antialias=True),
    RenderSettings(depth=True, branches=True, imagegrad=True),
]


def rendered(device, settings, channels=None, seed=3):
    splats = as_leaves(make_splats(200, seed, channels).to(device))
    camera = make_camera().to(device)
    behind = torch.linspace(0.1, 0.8, splats.num_channels, device=device)
    result = render(splats, camera, behind, settings)
    layers = [layer for layer in (result.joint, result.static, result.dynamic) if layer is not None]
    outputs = [value for layer in layers for value in layer if value is not None]
    if settings.depth:  # where alpha is tiny, depth is divided by it
        outputs = [value * layer.alpha.detach() for layer in layers for value in (layer.depth, layer.alpha)]
        outputs += [layer.image for layer in layers]
    weighted_sum(outputs, [c.to(device) for c in random_like(outputs)]).backward()
    statistics = [result.gradient_norms, *([result.weights] if settings.statistics else [])]
    return [t.detach().cpu() for t in (*outputs, *statistics, *gradients(splats).values())]


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "branches", "depth", "branches and depth"])
def test_images_and_gradients_equal_those_on_cpu(settings):
    for actual, expected in zip(rendered("cuda", settings), rendered("cpu", settings), strict=True):
        assert relative_error(actual, expected) < 1e-5


def test_five_channels_equal_those_on_cpu():
    for actual, expected in zip(rendered("cuda", SETTINGS[0], 5), rendered("cpu", SETTINGS[0], 5), strict=True):
        assert relative_error(actual, expected) < 1e-5


def test_similarity_and_its_gradient_equal_those_on_cpu():
    values = []
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        image, target = (torch.rand(70, 50, 3).to(device).requires_grad_(k == 0) for k in range(2))
        similarity = ssim_map(image, target)
        similarity.square().sum().backward()
        values.append([similarity.detach().cpu(), image.grad.cpu()])
    for expected, actual in zip(*values, strict=True):
        assert relative_error(actual, expected) < 1e-5


def test_losses_and_their_gradients_equal_those_on_cpu():
    def pull(device):
        depth, alpha, inverse_depth, alignment, region = (t.to(device) for t in random_inputs(70, 50, generator()))
        image, target = torch.rand(2, 70, 50, 3, generator=generator()).to(device)
        image.requires_grad_()
        depth.requires_grad_()
        values = [
            l1_and_ssim(image, target, 0.2, region),
            depth_error(depth, alpha, inverse_depth, alignment, region),
        ]
        sum(values).backward()
        return [t.detach().cpu() for t in (*values, image.grad, depth.grad)]

    for actual, expected in zip(pull("cuda"), pull("cpu"), strict=True):
        assert relative_error(actual, expected) < 1e-5


@pytest.mark.parametrize("size", [(300, 200), (1100, 900)])
def test_every_image_equals_that_of_its_splats_rendered_alone(size):
    splats, camera = make_splats(4000).to("cuda"), make_camera(*size).to("cuda")
    splats.opacities.clamp_(min=0.5)
    in_front = splats.means @ camera.viewmat[2, :3] < torch.quantile(splats.means @ camera.viewmat[2, :3], 0.3)
    for dynamic in (in_front, ~in_front, splats.means[:, 0] < 0):
        branches = dataclasses.replace(splats, is_dynamic=dynamic)
        rendering = render(branches, camera, settings=RenderSettings(branches=True))
        for selected, layer in ((~dynamic, rendering.static), (dynamic, rendering.dynamic)):
            fields = {n: t[selected] for n in splats.tensor_names() if (t := getattr(splats, n)) is not None}
            alone = render(dataclasses.replace(splats, **fields), camera).joint
            assert relative_error(layer.image, alone.image) < 1e-5
            assert relative_error(layer.alpha, alone.alpha) < 1e-5


def test_an_empty_scene_is_background():
    behind = torch.tensor([0.1, 0.2, 0.3], device="cuda")
    image = render(make_splats(0).to("cuda"), make_camera().to("cuda"), behind).joint.image
    assert torch.equal(image, behind.expand_as(image))


def test_a_render_can_be_captured_and_replayed():
    splats, camera = make_splats().to("cuda"), make_camera().to("cuda")
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.no_grad(), torch.cuda.stream(stream):
        for _ in range(3):
            render(splats, camera)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.no_grad(), torch.cuda.graph(graph):
        image = render(splats, camera).joint.image
    splats.means.add_(0.1)
    graph.replay()
    torch.cuda.synchronize()
    assert relative_error(image, render(splats, camera).joint.image) < 1e-6


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "branches", "depth", "branches and depth"])
def test_repeated_renders_are_replayed(settings, monkeypatch):
    monkeypatch.setattr(replay, "_signatures", {})
    for seed in range(2 * EAGER_CALLS):
        eager = rendered("cuda", dataclasses.replace(settings, replay=False), seed=seed)
        for actual, expected in zip(rendered("cuda", settings, seed=seed), eager, strict=True):
            assert relative_error(actual, expected) < 1e-4  # two eager calls differ by up to 1e-5, by atomic sums
    (signature,) = replay._signatures.values()
    assert signature.recordings == 1


def test_renders_without_visible_gaussians_are_replayed():
    reset_budgets()
    camera = make_camera(72, 40).to("cuda")
    for _ in range(2 * EAGER_CALLS):
        splats = as_leaves(make_splats(50).to("cuda"))
        with torch.no_grad():
            splats.opacities.zero_()
        image = render(splats, camera, torch.full((3,), 0.5, device="cuda")).joint.image
        assert (image == 0.5).all()
        image.sum().backward()
        assert not splats.means.grad.any()


def test_a_recording_holds_no_tensors_of_its_caller():
    kept = []
    for seed in range(2 * EAGER_CALLS):
        splats = as_leaves(make_splats(200, seed=seed).to("cuda"))
        render(splats, make_camera(64, 48).to("cuda")).joint.image.sum().backward()
        kept += [weakref.ref(t) for t in (splats.means, splats.means.grad)]
    del splats
    gc.collect()
    assert not any(reference() is not None for reference in kept)
