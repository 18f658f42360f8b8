"""Training on the GPU: replayed steps are eager ones, and half precision loses little."""

import dataclasses

import pytest
import torch

from tests import tiny
from tests.scenes import generator, relative_error
from warpgs.fields.perceptron import perceptron
from warpgs.playback import Player

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
STEPS = 50


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("cache"))


def trainer_on_cuda(data, run, **changes):
    return tiny.trainer(data, run, dataclasses.replace(tiny.CONFIG, device="cuda", **changes))


def parameters_after_steps(data, run, **changes):
    """After iterations of stage II with one set of Gaussians, which is where most of a run's time goes."""
    trainer = trainer_on_cuda(data, run, **changes)
    trainer._add_dynamic()
    moment = trainer.protocol.at(trainer.protocol.stage2.start)
    for iteration in range(STEPS):
        trainer.iteration = iteration
        trainer.step(moment, trainer._draw(moment))
    torch.cuda.synchronize()
    return {name: p.detach().clone() for name, p in trainer.scene.named_parameters()}


def test_replayed_steps_change_parameters_as_eager_ones_do(data, tmp_path):
    """Not to the bit: the GPU adds gradients up in another order every time."""
    eager = parameters_after_steps(data, tmp_path / "eager", graph=False)
    replayed = parameters_after_steps(data, tmp_path / "replayed", graph=True)
    for name, expected in eager.items():
        if expected.any():
            assert relative_error(replayed[name], expected) < 1e-3, name


def test_a_run_with_graphs_goes_through_all_stages(data, tmp_path):
    trainer = trainer_on_cuda(data, tmp_path / "run")
    assert tiny.train(trainer)
    assert all(p.isfinite().all() for p in trainer.scene.parameters())


def test_a_played_frame_is_the_rendered_one(data, tmp_path):
    trainer = trainer_on_cuda(data, tmp_path / "run")
    tiny.train(trainer)
    player = Player(trainer.scene, trainer.config, {"moving": True, "relit": True, "sh_degree": 1})
    cameras = [trainer.capture.cameras[name].to("cuda") for name in trainer.capture.train[:3]]
    for camera in cameras:
        assert relative_error(player.play(camera), player(camera, False).joint.image) < 1e-5


def layers(widths, extra, skip):
    g = generator()
    reads = [w + (extra if k == skip else 0) for k, w in enumerate([extra, *widths[:-1]])]
    weights = [torch.randn(w, r, generator=g) / r**0.5 for w, r in zip(widths, reads, strict=True)]
    return weights, [0.1 * torch.randn(w, generator=g) for w in widths]


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e6])
@pytest.mark.parametrize("num", [0, 1, 1000])
def test_half_precision_loses_little_whatever_the_size_of_gradients(num, scale):
    encoding = torch.rand(num, 21, generator=generator()) * 2 - 1
    cotangent = scale * torch.randn(num, 10, generator=generator(1))
    results = []
    for dtype, device in ((torch.float64, "cpu"), (torch.float16, "cuda")):
        weights, biases = layers([64, 64, 64, 64, 10], 21, skip=2)
        kind = torch.float32 if device == "cuda" else dtype
        parameters = [p.to(device, kind).requires_grad_() for p in (*weights, *biases)]
        inputs = torch.nn.functional.pad(encoding.to(device, dtype), (64, 3))  # room before, padding behind
        outputs = perceptron(inputs, parameters[:5], parameters[5:], skip=2)
        outputs.backward(cotangent.to(device, kind))
        results.append([outputs.detach().cpu().double(), *(p.grad.cpu().double() for p in parameters)])
    for expected, actual in zip(*results, strict=True):
        assert actual.shape == expected.shape
        assert (actual - expected).norm() <= 5e-3 * expected.norm()
