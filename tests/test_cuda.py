"""Renders and losses on the GPU equal those on the CPU."""

import dataclasses
import math

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from tests.ops.test_mlp import LAYERS, assert_nan_stays_in_its_row, random_layer
from tests.ops.test_sort import CASES, random_keys, sorted_pairs
from tests.ops.test_tiles import binned, projected
from tests.reference.depth_error import random_inputs
from tests.reference.projection import Projection
from tests.scenes import (
    GEOMETRY,
    as_leaves,
    generator,
    gradients,
    make_camera,
    make_splats,
    random_like,
    relative_error,
    weighted_sum,
)
from warpgs.bench.workloads import graphed, make_workload, parameter_names
from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.distortion import Distortion
from warpgs.kernels.constants import CULLED_DEPTH
from warpgs.ops.depth_error import depth_error
from warpgs.ops.dropout import dropout
from warpgs.ops.mlp import layer_bwd
from warpgs.ops.projection import Geometry, View, project_fwd
from warpgs.ops.ssim import l1_and_ssim, ssim_map
from warpgs.ops.tiles import reset_budgets
from warpgs.rendering import render
from warpgs.runtime.graphs import capture, record
from warpgs.runtime.streams import concurrently, side_stream

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
SETTINGS = [
    RenderSettings(),
    RenderSettings(branches=True, statistics=True),
    RenderSettings(depth=True, antialias=True),
    RenderSettings(depth=True, branches=True, absgrad=True),
]


def rendered(device, settings, channels=None, seed=3):
    splats = as_leaves(make_splats(200, seed, channels).to(device))
    camera = make_camera().to(device)
    behind = torch.linspace(0.1, 0.8, splats.num_channels, device=device)
    offsets = torch.zeros(200, 2, device=device, requires_grad=True)
    result = render(splats, camera, behind, settings, offsets)
    layers = [layer for layer in (result.joint, result.static, result.dynamic) if layer is not None]
    outputs = [value for layer in layers for value in layer if value is not None]
    if settings.depth:  # where alpha is tiny, depth is divided by it
        outputs = [value * layer.alpha.detach() for layer in layers for value in (layer.depth, layer.alpha)]
        outputs += [layer.image for layer in layers]
    weighted_sum(outputs, [c.to(device) for c in random_like(outputs)]).backward()
    statistics = [offsets.grad, *([result.weights] if settings.statistics else [])]
    return [t.detach().cpu() for t in (*outputs, *statistics, *gradients(splats).values())]


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "branches", "depth", "branches and depth"])
def test_images_and_gradients_equal_those_on_cpu(settings):
    for actual, expected in zip(rendered("cuda", settings), rendered("cpu", settings), strict=True):
        assert relative_error(actual, expected) < 1e-5


def test_dropout_omits_the_same_gaussians_as_on_cpu():
    opacities, seed = torch.rand(1000, generator=generator(0)), torch.tensor([2.0**24 - 1.0])
    assert torch.equal(dropout(opacities.cuda(), seed.cuda(), 0.3).cpu(), dropout(opacities, seed, 0.3))


def test_five_channels_equal_those_on_cpu():
    for actual, expected in zip(rendered("cuda", SETTINGS[0], 5), rendered("cpu", SETTINGS[0], 5), strict=True):
        assert relative_error(actual, expected) < 1e-5


@pytest.mark.parametrize("is_rolling", [False, True])
@pytest.mark.parametrize(("lens", "coefficients"), [("radial", [-0.2, 0.05, 0.01]), ("fisheye", [0.05, -0.02])])
def test_images_and_gradients_through_a_lens_equal_those_on_cpu(lens, coefficients, is_rolling):
    def pull(device):
        splats, view = as_leaves(make_splats(200).to(device)), make_camera().to(device)
        values = torch.tensor(coefficients, requires_grad=True)
        distortion = getattr(Distortion, lens)(values, view.K, view.size)
        motion = torch.tensor([[0.05, -0.08, 0.03], [0.1, 0.06, -0.05]], device=device, requires_grad=True)
        parts = {"distortion": distortion, "motion": motion if is_rolling else None}
        image = render(splats, dataclasses.replace(view, **parts)).joint.image
        image.square().sum().backward()
        trained = (values, motion) if is_rolling else (values,)
        return [t.detach().cpu() for t in (image, *(t.grad for t in trained), *gradients(splats).values())]

    for actual, expected in zip(pull("cuda"), pull("cpu"), strict=True):
        assert relative_error(actual, expected) < 1e-5


@pytest.mark.parametrize("turn", [1.0, -1.0])  # the seam is behind or ahead
def test_images_and_gradients_of_a_panorama_equal_those_on_cpu(turn):
    def pull(device):
        splats = as_leaves(make_splats(200).to(device))
        K = torch.tensor([[96 / (2 * math.pi), 0.0, 48.0], [0.0, 48 / math.pi, 24.0], [0.0, 0.0, 1.0]])
        viewmat = torch.diag(torch.tensor([turn, 1.0, turn, 1.0])) @ make_camera().viewmat
        view = Camera(viewmat, K, 96, 48, distortion=Distortion.equirectangular()).to(device)
        image = render(splats, view, settings=RenderSettings(depth=True, statistics=True)).joint.image
        image.square().sum().backward()
        return [t.detach().cpu() for t in (image, *gradients(splats).values())]

    for actual, expected in zip(pull("cuda"), pull("cpu"), strict=True):
        assert relative_error(actual, expected) < 1e-5


def test_images_and_gradients_through_a_rolling_shutter_equal_those_on_cpu():
    def pull(device):
        splats = as_leaves(make_splats(200).to(device))
        motion = torch.tensor([[0.05, -0.08, 0.03], [0.1, 0.06, -0.05]], device=device, requires_grad=True)
        image = render(splats, dataclasses.replace(make_camera().to(device), motion=motion)).joint.image
        image.square().sum().backward()
        return [t.detach().cpu() for t in (image, motion.grad, *gradients(splats).values())]

    for actual, expected in zip(pull("cuda"), pull("cpu"), strict=True):
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
        depth, *constants = (t.to(device) for t in random_inputs(70, 50, generator()))
        image, target = torch.rand(2, 70, 50, 3, generator=generator()).to(device)
        image.requires_grad_()
        depth.requires_grad_()
        values = [l1_and_ssim(image, target, 0.2, constants[3]), depth_error(depth, *constants)]
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


@pytest.mark.parametrize("sizes", [*LAYERS, (4992, 256, 256, (88, 0)), (50_048, 56, 256, (0, 88))])
def test_the_gradient_before_a_layer_equals_that_on_cpu(sizes):
    layer = random_layer(*sizes)
    results = []
    for device in ("cpu", "cuda", "cuda"):
        v_outputs, weight, features, sums = (tensor.to(device, copy=True) for tensor in layer)
        padded = torch.nn.functional.pad(weight, (0, 0, 0, 32), value=torch.nan)  # what must not be read
        weight = padded[: len(weight)]
        results.append((layer_bwd(v_outputs, weight, features, sums).cpu(), sums.cpu()))
    expected, actual, again = results
    for own, wanted, same in zip(actual, expected, again, strict=True):
        assert relative_error(own, wanted) < 1e-4
        assert torch.equal(own, same)


def test_nan_passes_the_backward_pass_of_a_layer():
    assert_nan_stays_in_its_row("cuda")


def test_matrices_that_start_anywhere_are_refused():
    v_outputs, features = (torch.zeros(8, 8, dtype=torch.float16, device="cuda") for _ in range(2))
    shifted = torch.zeros(65, dtype=torch.float16, device="cuda")[1:].view(8, 8)
    with pytest.raises(ValueError, match=r"weight must start at a multiple of 16 bytes"):
        layer_bwd(v_outputs, shifted, features, torch.zeros(1, 8, device="cuda"))


def test_an_empty_scene_is_background():
    behind = torch.tensor([0.1, 0.2, 0.3], device="cuda")
    image = render(make_splats(0).to("cuda"), make_camera().to("cuda"), behind).joint.image
    assert torch.equal(image, behind.expand_as(image))


def image_of(splats, camera, settings=None):
    """A render as a function of the tensors that get gradients here."""

    def image(means, sh):
        return render(dataclasses.replace(splats, means=means, sh=sh), camera, settings=settings).joint.image

    return image


def image_and_gradients(image, splats):
    inputs = [splats.means.detach().clone().requires_grad_(), splats.sh.detach().clone().requires_grad_()]
    rendered = image(*inputs)
    return [rendered.detach(), *torch.autograd.grad(rendered.square().sum(), inputs)]


BOUNDED = RenderSettings(max_intersections=20_000)
BOTH = pytest.mark.parametrize("settings", [None, BOUNDED], ids=["learned", "bounded"])


def on_another_stream(work):
    """Runs work on a stream of its own, as before a capture."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            work()
    torch.cuda.current_stream().wait_stream(stream)


@BOTH
def test_a_render_can_be_captured_and_replayed(settings, capfd):
    splats, camera = make_splats(200).to("cuda"), make_camera().to("cuda")
    inputs = [splats.means.requires_grad_(), splats.sh.requires_grad_()]

    def step():
        image = image_of(splats, camera, settings)(*inputs)
        return (image, *torch.autograd.grad(image.square().sum(), inputs))

    on_another_stream(step)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outputs = step()
    for seed in (4, 5):
        other = make_splats(200, seed).to("cuda")
        with torch.no_grad():
            for tensor, new in zip(inputs, (other.means, other.sh), strict=True):
                tensor.copy_(new)
        graph.replay()
        torch.cuda.synchronize()
        expected = image_and_gradients(image_of(splats, camera), splats)
        for actual, wanted in zip(outputs, expected, strict=True):
            assert relative_error(actual, wanted) < 1e-4  # two calls differ by up to 1e-5, by atomic sums
    assert "Warp" not in capfd.readouterr().err


# torch's own warm-up, on another stream than its capture, makes it warn.
@pytest.mark.filterwarnings("ignore:The AccumulateGrad node's stream does not match")
@BOTH
def test_a_render_can_be_a_graphed_callable(settings):
    splats, camera = make_splats(200).to("cuda"), make_camera().to("cuda")
    image = image_of(splats, camera, settings)
    sample = (splats.means.clone().requires_grad_(), splats.sh.clone().requires_grad_())
    graphed = torch.cuda.make_graphed_callables(image, sample)
    for seed in (4, 5, 4):
        other = make_splats(200, seed).to("cuda")
        expected = image_and_gradients(image, other)
        for actual, wanted in zip(image_and_gradients(graphed, other), expected, strict=True):
            assert relative_error(actual, wanted) < 1e-4


@pytest.mark.parametrize("channels", [3, None])
def test_graphed_workloads_of_the_benchmark_compute_the_same(channels):
    splats, camera = make_splats(200, channels=channels).to("cuda"), make_camera().to("cuda")
    for name in parameter_names(splats):
        getattr(splats, name).requires_grad_()
    workload = make_workload(splats, camera, RenderSettings(branches=True, depth=True))
    expected = workload.forward_backward()
    for actual, wanted in zip(graphed(workload).forward_backward(), expected, strict=True):
        assert relative_error(actual, wanted) < 1e-4


def test_a_device_without_an_index_has_the_side_stream_of_the_current_one():
    assert side_stream(torch.device("cuda")) is side_stream(torch.device("cuda", torch.cuda.current_device()))


def test_harmonics_may_begin_anywhere_in_memory():
    splats, camera = make_splats(200).to("cuda"), make_camera().to("cuda")
    shifted = torch.empty(splats.sh.numel() + 1, device="cuda")[1:].view(splats.sh.shape).copy_(splats.sh)
    assert shifted.data_ptr() % 16 != 0
    expected, actual = (as_leaves(splats), dataclasses.replace(as_leaves(splats), sh=shifted.requires_grad_()))
    for own in (expected, actual):
        render(own, camera).joint.image.square().sum().backward()
    assert relative_error(actual.sh.grad, expected.sh.grad) < 1e-5
    assert relative_error(actual.means.grad, expected.means.grad) < 1e-5


def test_a_bounded_render_needs_no_render_of_its_size_before():
    splats = make_splats(200).to("cuda")
    with torch.no_grad():
        render(splats, make_camera().to("cuda"), settings=BOUNDED)  # loads the kernels
        camera, graph = make_camera(67, 41).to("cuda"), torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            captured = render(splats, camera, settings=BOUNDED)
        graph.replay()
        torch.cuda.synchronize()
        expected = render(splats, camera)
    assert torch.equal(captured.joint.image, expected.joint.image)
    assert 0 < int(captured.num_intersections) < BOUNDED.max_intersections


def test_the_first_render_of_a_size_cannot_be_captured_unless_it_is_bounded():
    reset_budgets()
    splats, camera = make_splats(200).to("cuda"), make_camera(69, 43).to("cuda")
    with (
        torch.no_grad(),
        pytest.raises(RuntimeError, match="captures the first render of 69 x 43 pixels"),
        torch.cuda.graph(torch.cuda.CUDAGraph()),
    ):
        render(splats, camera)
    assert render(splats, camera).joint.image.isfinite().all()


def test_a_replay_with_more_intersections_than_its_buffers_hold_is_complete():
    splats, camera = make_splats(200).to("cuda"), make_camera(300, 200).to("cuda")
    splats.scales.mul_(0.1)
    settings = RenderSettings(max_intersections=1_000)
    with torch.no_grad():
        on_another_stream(lambda: render(splats, camera, settings=settings))
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            captured = render(splats, camera, settings=settings)
        splats.scales.mul_(20.0)
        graph.replay()
        torch.cuda.synchronize()
        assert int(captured.num_intersections) > 1_000
        assert torch.equal(captured.joint.image, render(splats, camera).joint.image)


@pytest.mark.parametrize(("num_pairs", "num_bits"), [*CASES, (300_000, 9), (1_000_003, 31), (5_000_000, 13)])
def test_sorted_pairs_equal_a_stable_sort(num_pairs, num_bits):
    keys = random_keys(num_pairs, num_bits).cuda()
    expected = torch.sort(keys, stable=True)
    for _ in range(3):
        actual, came_from = sorted_pairs(keys, num_bits)
        assert torch.equal(actual, expected.values)
        assert torch.equal(came_from, expected.indices.int())


def test_a_sort_of_equal_keys_leaves_all_pairs_where_they_are():
    keys = torch.full((100_000,), (1 << 31) - 1, dtype=torch.int32, device="cuda")
    actual, came_from = sorted_pairs(keys, 31)
    assert torch.equal(actual, keys)
    assert torch.equal(came_from, torch.arange(100_000, device="cuda", dtype=torch.int32))


# Blocks have 256 threads, a look-back reads 32 of them at once, and the buffers have room for more than all lists.
@pytest.mark.parametrize("num", [1, 255, 256, 257, 8191, 8192, 8193, 20_000])
def test_the_lists_of_tiles_equal_those_on_cpu(num):
    size = (480, 270)
    splats = projected(*size, num)
    expected, number = binned(splats, *size)
    splats = Projection(*(t.cuda() for t in splats))  # a projection on CUDA may round depths otherwise
    reset_budgets()
    lists, actual = binned(splats, *size)
    assert sum(map(len, lists)) == actual
    # Where an ellipse grazes a tile, rounding decides.
    different = sum(len(set(a) ^ set(e)) for a, e in zip(lists, expected, strict=True))
    assert max(different, abs(actual - number)) <= 1e-4 * number
    same = [a == e for a, e in zip(lists, expected, strict=True) if set(a) == set(e)]
    assert all(same)
    for max_intersections in (None, actual, actual + 1000):
        assert binned(splats, *size, max_intersections) == (lists, actual)


@pytest.mark.parametrize("num", [1, 255, 256, 257, 8191, 8192, 8193, 20_000])
def test_projection_prepares_binning_in_memory_that_was_used(num):
    splats, camera = make_splats(num).to("cuda"), make_camera().to("cuda")
    geometry = Geometry(*(getattr(splats, name) for name in GEOMETRY))
    view, features = View(camera.viewmat, camera.K, *camera.size), torch.rand(num, 3, device="cuda")
    with torch.no_grad():  # what it frees is not zero
        render(splats, camera)
    _, radii, order = project_fwd(geometry, features, view, 0.01, False, False)
    assert not order.scan_words.any()
    assert not order.sort_counters.any()
    assert torch.equal(order.gaussian_from_rank[:num], torch.arange(num, device="cuda", dtype=torch.int32))
    assert torch.equal(order.keys[:num] == CULLED_DEPTH, radii[:, 0] == 0)


@pytest.mark.parametrize("branches", [False, True])
def test_with_too_many_intersections_a_large_render_is_the_same(branches):
    splats, camera = make_splats(20_000).to("cuda"), make_camera(480, 270).to("cuda")
    with torch.no_grad():
        few, enough = (
            render(splats, camera, settings=RenderSettings(branches=branches, max_intersections=number))
            for number in (1, 10_000_000)
        )
    assert torch.equal(few.joint.image, enough.joint.image)
    if branches:
        assert torch.equal(few.static.image, enough.static.image)
        assert torch.equal(few.dynamic.image, enough.dynamic.image)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one CUDA device")
def test_a_render_on_another_than_the_current_gpu_is_the_same():
    def image_and_gradients_on(device):
        splats = as_leaves(make_splats(200).to(device))
        image = render(splats, make_camera().to(device)).joint.image
        image.square().sum().backward()
        return [t.detach().cpu() for t in (image, *gradients(splats).values())]

    torch.cuda.set_device(0)
    on_the_other = image_and_gradients_on("cuda:1")
    assert torch.cuda.current_device() == 0
    for actual, expected in zip(on_the_other, image_and_gradients_on("cuda:0"), strict=True):
        assert relative_error(actual, expected) < 1e-5


def test_a_checkpointed_render_has_the_same_gradients():
    splats, camera = make_splats(200).to("cuda"), make_camera().to("cuda")
    image = image_of(splats, camera)
    expected = image_and_gradients(image, splats)
    checkpointed = image_and_gradients(lambda *inputs: checkpoint(image, *inputs, use_reentrant=False), splats)
    for actual, wanted in zip(checkpointed, expected, strict=True):
        assert relative_error(actual, wanted) < 1e-4


def test_after_an_error_in_a_capture_it_is_reported_and_the_next_capture_works():
    device = torch.device("cuda", torch.cuda.current_device())

    def fail():
        with concurrently(device) as beside:
            with beside:
                torch.ones(3, device=device).sum()
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        record(fail)
    (total,) = capture(lambda: (torch.ones(3, device=device).sum(),))()
    assert total == 3


def test_points_have_the_same_depths_and_pixels():
    points, camera = torch.randn(1000, 3, generator=generator(2)), make_camera()
    expected, found = camera.project(points), camera.to("cuda").project(points.cuda())
    assert relative_error(found[2].cpu(), expected[2]) < 1e-6
    assert sum(int((a != b.cpu()).sum()) for a, b in zip(expected[:2], found[:2], strict=True)) <= 4  # at borders
    assert torch.equal(expected[3], found[3].cpu())


def test_garbage_with_another_graph_does_not_break_a_capture():
    """Freeing the memory of a graph is not allowed during a capture."""
    values = torch.ones(1000, device="cuda")

    def work():
        for _ in range(10_000):  # each is garbage that Python would collect on its way
            cycle = []
            cycle.append(cycle)
        return (values * 2.0,)

    garbage = [capture(lambda: (values.repeat(100_000) + 1.0,))]
    garbage.append(garbage)
    del garbage
    (doubled,) = capture(work)()
    assert torch.equal(doubled, torch.full_like(values, 2.0))
