"""Training on the GPU: replayed steps equal eager ones, and half precision loses little."""

import dataclasses
import shutil
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from tests import tiny
from tests.data.captures import edit_json
from tests.initialization.test_motion_fit import TIMES, UNEVEN, VIEW_SIZE, fit, max_error, new_deformation
from tests.scenes import generator, relative_error
from warpgs.config.presets import PRESETS
from warpgs.initialization import motion_fit
from warpgs.model.fields import FIELDS
from warpgs.model.trunk import Trunk
from warpgs.ops.encoding import ROW_ALIGNMENT, aligned
from warpgs.ops.mlp import num_values, perceptron, split
from warpgs.rendering import render
from warpgs.runs.checkpoint import Metadata
from warpgs.runs.trained import TrainedScene
from warpgs.runtime.graphs import WARM_UPS, capture
from warpgs.runtime.profiling import profile
from warpgs.training.density import DENSITY
from warpgs.training.density.prune import blend_weights
from warpgs.training.density.reseed import lost_fraction, lost_pixels

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
STEPS = 50


def trainer_on_cuda(data, run, **changes):
    return tiny.trainer(data, run, dataclasses.replace(tiny.CONFIG, device="cuda", **changes))


def parameters_after_steps(data, run, **changes):
    """Parameters and observations for densification after iterations of stage II with constant numbers of Gaussians."""
    optim = dataclasses.replace(tiny.CONFIG.optim, poses=1e-3)
    trainer = trainer_on_cuda(data, run, optim=optim, **changes)
    trainer._add_dynamic_gaussians()
    with torch.no_grad():  # the rotation of a sphere would get gradients from rounding errors only
        trainer.scene.dynamic.log_scales += torch.linspace(-0.5, 0.5, 3, device="cuda")
    plan = trainer.protocol.at(trainer.protocol.stage2.start)
    for iteration in range(STEPS):
        trainer.iteration = iteration
        trainer.views.announce(trainer._sampler.views(iteration, 0))
        trainer.step(plan, trainer._sample(plan))
    torch.cuda.synchronize()
    return {name: p.detach().clone() for name, p in (trainer.step.parameters() | trainer.step.density.state()).items()}


@pytest.mark.parametrize("fields", [{}, {"radial_distortion": [0.1, 0.01, 0.0]}, {"fisheye_distortion": [0.05]}])
@pytest.mark.parametrize(("resident_bytes", "background"), [(1 << 30, "black"), (0, "black"), (1 << 30, "sky")])
def test_replayed_steps_change_parameters_as_eager_steps_do(data, tmp_path, resident_bytes, background, fields):
    """Up to noise: the GPU adds gradients in an order that varies, and Adam amplifies tiny ones."""
    data = shutil.copytree(data, tmp_path / "capture")
    for path in (data / "camera").iterdir():
        edit_json(path, **fields)
    replayed = require_equal_steps(data, tmp_path, {"resident_bytes": resident_bytes}, background=background)
    assert ("dome.texels" in replayed) == (background == "sky")


def test_replayed_steps_of_several_segments_change_parameters_as_eager_steps_do(data, tmp_path):
    require_equal_steps(data, tmp_path, {}, model=dataclasses.replace(tiny.MODEL, segments=2))


def require_equal_steps(data, tmp_path, of_replayed, **changes):
    """Compares parameters after steps; returns those after replayed ones."""
    eager, again = (parameters_after_steps(data, tmp_path / f"eager{k}", graph=False, **changes) for k in range(2))
    replayed = parameters_after_steps(data, tmp_path / "replayed", graph=True, **of_replayed, **changes)
    for name, expected in eager.items():
        if expected.any():
            noise = relative_error(again[name], expected)
            assert relative_error(replayed[name], expected) < max(1e-3, 4.0 * noise), name
    return replayed


@pytest.mark.parametrize("strategy", DENSITY)
def test_a_run_with_graphs_passes_all_stages(data, tmp_path, strategy):
    densify = dataclasses.replace(tiny.CONFIG.densify, strategy=strategy)
    trainer = trainer_on_cuda(data, tmp_path / "run", densify=densify)
    assert tiny.train(trainer)
    assert all(p.isfinite().all() for p in trainer.scene.parameters())


@pytest.mark.parametrize("background", ["mean", "sky"])
def test_a_played_frame_equals_the_rendered_one(data, tmp_path, background):
    trainer = trainer_on_cuda(data, tmp_path / "run", background=background)
    tiny.train(trainer)
    metadata = Metadata(iteration=tiny.LENGTH, use_deformation=True, use_appearance=True, sh_degree=1)
    scene = TrainedScene(trainer.scene, trainer.config, metadata)
    cameras = [trainer.capture.cameras[name].to("cuda") for name in trainer.capture.train[:3]]
    for camera in cameras:
        assert relative_error(scene.play(camera), scene.render(camera).joint.image) < 1e-5
        assert scene.is_captured(camera.size)


def test_a_frame_is_captured_on_whatever_thread_plays_it_first(data, tmp_path):
    trainer = trainer_on_cuda(data, tmp_path / "run")
    tiny.train(trainer)
    metadata = Metadata(iteration=tiny.LENGTH, use_deformation=True, use_appearance=True, sh_degree=1)
    scene = TrainedScene(trainer.scene, trainer.config, metadata)
    camera = trainer.capture.cameras[trainer.capture.train[0]].to("cuda")
    small = dataclasses.replace(camera, width=camera.width // 2)
    scene.play(small)
    with ThreadPoolExecutor(1) as other:
        for seen in (small, camera):
            assert relative_error(other.submit(scene.play, seen).result(), scene.render(seen).joint.image) < 1e-5
            assert scene.is_captured(seen.size)


@pytest.mark.parametrize("appearance", ["color", "all"])
@pytest.mark.parametrize("captured", [False, True])
def test_concurrent_networks_compute_the_same_as_one_after_the_other(data, tmp_path, appearance, captured):
    model = dataclasses.replace(tiny.MODEL, appearance=appearance)
    trainer = trainer_on_cuda(data, tmp_path / "run", model=model)
    tiny.train(trainer)
    scene, camera = trainer.scene, trainer.capture.cameras[trainer.capture.train[0]].to("cuda")
    scene.requires_grad_(True)
    time = torch.tensor([camera.time], device="cuda")

    def image_and_gradients():
        image = render(scene.splats(time), camera).joint.image
        return (image.detach(), *torch.autograd.grad(image.square().sum(), list(scene.parameters())))

    concurrent = capture(image_and_gradients)() if captured else image_and_gradients()
    with profile():  # which turns concurrency off
        serial = image_and_gradients()
    for actual, expected in zip(concurrent, serial, strict=True):
        assert relative_error(actual, expected) < 1e-4


def test_graphs_that_are_captured_again_reuse_the_memory(data, tmp_path):
    trainer = trainer_on_cuda(data, tmp_path / "run")
    trainer._add_dynamic_gaussians()
    plan = trainer.protocol.at(trainer.protocol.stage2.start)
    reserved = []
    for _ in range(8):
        trainer.step.begin_density()
        for _ in range(WARM_UPS + 2):
            trainer.step(plan, trainer._sample(plan))
        torch.cuda.synchronize()
        reserved.append(torch.cuda.memory_reserved())
    assert reserved[-1] <= reserved[2]


@pytest.mark.parametrize("resident_bytes", [1 << 30, 0])
def test_work_on_all_views_is_the_same_in_a_graph(data, tmp_path, resident_bytes):
    trainer = trainer_on_cuda(data, tmp_path / "run", resident_bytes=resident_bytes)
    tiny.train(trainer)
    phase = trainer.protocol.phase_at(tiny.LENGTH - 1)

    def results():
        mask_of = lost_pixels(trainer.scene, phase, trainer.config.render_settings)
        return blend_weights(trainer.scene, trainer.views, phase), lost_fraction(trainer.views, mask_of)

    assert trainer.views.uses_graphs
    weights, lost = results()
    trainer.views.uses_graphs = False
    expected, expected_lost = results()
    assert expected.count_nonzero() > 1
    assert relative_error(weights, expected) < 1e-5
    assert lost == pytest.approx(expected_lost)


@pytest.mark.parametrize("model", FIELDS)
def test_canonical_positions_are_the_same_in_a_graph(model):
    deformation = new_deformation("cuda", deformation=model)
    fit(UNEVEN, deformation, 50)
    points = motion_fit._PointsByView(UNEVEN, TIMES, VIEW_SIZE, torch.device("cuda"), generator())
    eager, replayed = (points.canonical(deformation, UNEVEN, is_replayed) for is_replayed in (False, True))
    assert torch.equal(eager.views, replayed.views)
    assert relative_error(replayed.positions, eager.positions) < 1e-3


@pytest.mark.parametrize("model", FIELDS)
def test_a_replayed_fit_to_points_changes_parameters_as_an_eager_one_does(model):
    """Up to noise, as above."""

    def parameters(graph):
        deformation = new_deformation("cuda", deformation=model)
        fit(UNEVEN, deformation, 20, graph=graph)
        return {name: p.detach() for name, p in deformation.named_parameters()}

    eager, again, replayed = parameters(False), parameters(False), parameters(True)
    new = new_deformation("cuda", deformation=model).state_dict()
    for name, expected in eager.items():
        assert not torch.equal(expected, new[name])
        noise = relative_error(again[name], expected)
        assert relative_error(replayed[name], expected) < max(1e-3, 4.0 * noise), name


@pytest.mark.parametrize("half", [False, True])
def test_a_replayed_fit_to_points_follows_objects_through_frames_with_few_points(monkeypatch, half):
    eager_steps, asked, take_step = [], [], motion_fit._take_step
    monkeypatch.setattr(motion_fit, "_take_step", lambda *args: eager_steps.append(0) or take_step(*args))
    deformation = new_deformation("cuda", half=half)
    canonical = fit(UNEVEN, deformation, 300, lambda: bool(asked.append(0)))
    assert (len(eager_steps), len(asked)) == (WARM_UPS + 1, 300)  # the capture calls it, too
    assert len(canonical.views) > 0.8 * len(UNEVEN.views)
    assert max_error(canonical, deformation) < 0.15  # the objects are 0.6 apart


def rounded(x):
    """Rounded to half precision in the forward pass; the backward pass is the identity."""
    return x + (x.detach().half().double() - x.detach())


def plain(encoding, weights, biases, skip):
    """The layers in double precision, with rounding wherever half precision is stored: otherwise ReLU units near zero,
    which pass gradients in one case only, would cause most of the difference."""
    encoding = values = rounded(encoding)
    for k, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
        values = torch.cat([values, encoding], 1) if k == skip else values
        values = rounded((values @ rounded(weight).T + rounded(bias)).clamp_min(0.0))
    return values @ rounded(weights[-1]).T + biases[-1]


@pytest.mark.parametrize(("num", "last"), [(61_249, 1), (70_545, 17), (81_349, 5), (83_340, 12)])
def test_gradients_of_weights_omit_no_gaussian(num, last):
    """On an H100, cuBLAS 13.0 omits the last rows of matrices of these sizes from the product of a head's gradient."""
    config = dataclasses.replace(PRESETS["paper"].model, half=True)
    trunk = Trunk(config, torch.zeros(3), torch.ones(3), (10,)).cuda()
    trunk.layers(trunk.values.data)[-1].weight.normal_()
    means, time = torch.rand(num, 3, device="cuda") * 2 - 1, torch.full((1,), 0.3, device="cuda")
    v_outputs = torch.zeros(num, 10, device="cuda")
    v_outputs[-last:].normal_()
    (actual,) = torch.autograd.grad(trunk(means, time)[0], trunk.values, v_outputs)
    (expected,) = torch.autograd.grad(trunk(means[-last:].contiguous(), time)[0], trunk.values, v_outputs[-last:])
    assert relative_error(actual, expected) < 1e-2


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e6])
@pytest.mark.parametrize("num", [0, 1, 1000])
@pytest.mark.parametrize("outputs", [(3,), (10,), (48, 1)])
def test_half_precision_loses_little_for_all_sizes_of_gradients(num, scale, outputs):
    g = generator()
    encoding = torch.rand(num, 21, generator=g).double() * 2 - 1
    shapes = [(64, 21), (64, 64), (64, 85), (64, 64), (sum(outputs), 64)]
    weights = [torch.randn(*shape, generator=g) / shape[1] ** 0.5 for shape in shapes]
    biases = [0.1 * torch.randn(rows, generator=g) for rows, _ in shapes]
    v_outputs = scale * torch.randn(num, sum(outputs), generator=g)

    expected = [p.double().requires_grad_() for p in (*weights, *biases)]
    values = plain(encoding, expected[:5], expected[5:], skip=2)
    values.backward(v_outputs.double())

    padded = [(64, 24), (64, 64), (64, 88), (64, 64), (aligned(sum(outputs)), 64)]
    flat = torch.zeros(num_values(padded))
    for layer, weight, bias in zip(split(flat, padded), weights, biases, strict=True):
        layer.weight[: weight.shape[0], : weight.shape[1]] = weight
        layer.bias[: len(bias)] = bias
    flat = flat.cuda().requires_grad_()
    # Columns for the hidden units before, padding after; rows of padding after.
    inputs = torch.nn.functional.pad(encoding.half().cuda(), (64, 3, 0, -num % ROW_ALIGNMENT))
    parts = perceptron(inputs, flat, padded, skip=2, outputs=outputs, num_rows=num)
    assert [part.shape for part in parts] == [(num, columns) for columns in outputs]
    assert all(part.is_contiguous() for part in parts)
    ours = torch.cat(parts, 1)
    ours.backward(v_outputs.cuda())

    gradients = split(flat.grad, padded)
    pairs = [(values.detach(), ours.detach())]
    pairs += [(e.grad, g.weight[: e.shape[0], : e.shape[1]]) for e, g in zip(expected[:5], gradients, strict=True)]
    pairs += [(e.grad, g.bias[: len(e)]) for e, g in zip(expected[5:], gradients, strict=True)]
    for e, a in pairs:
        assert a.shape == e.shape
        assert (a.detach().cpu().double() - e).norm() <= 5e-3 * e.norm()
