"""Whatever torch's default type is, everything is in single precision, with the same bits."""

import dataclasses

import pytest
import torch

import warpgs
from tests import tiny
from warpgs.config.presets import PRESETS
from warpgs.evaluation import evaluate_run
from warpgs.evaluation.lpips import Lpips
from warpgs.runs import checkpoint

pytestmark = pytest.mark.usefixtures("contracts_off")


@pytest.fixture
def in_double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def test_a_run_is_rendered_and_its_capture_read_with_the_same_bits(finished_run, in_double):
    torch.set_default_dtype(torch.float32)
    scene = warpgs.open_run(finished_run)
    capture = scene.open_capture()
    camera = capture.cameras[capture.train[0]].resized(60, 40)
    before = scene.render(camera, time=0.25, branches=True, depth=True)
    torch.set_default_dtype(torch.float64)
    scene = warpgs.open_run(finished_run)
    again = scene.open_capture()
    camera = again.cameras[again.train[0]].resized(60, 40)
    after = scene.render(camera, time=0.25, branches=True, depth=True)
    for one, other in zip(before[:3], after[:3], strict=True):
        assert torch.equal(one.image, other.image)
        assert one.image.dtype == one.depth.dtype == other.depth.dtype == torch.float32
    assert torch.equal(again.points, capture.points)
    assert torch.equal(again.assuming("dynamic").frame(again.val[0]).image, capture.frame(capture.val[0]).image)


def test_a_camera_of_plain_numbers_is_in_single_precision(in_double):
    camera = warpgs.Camera.looking_at([0, 0, -4], [0, 0, 0], [0, -1, 0], 80, (96, 64))
    row, column, depth, _ = camera.project(torch.zeros(1, 3, dtype=torch.float32))
    assert camera.unproject(row, column, depth).dtype == camera.K.dtype == camera.viewmat.dtype == torch.float32


def test_own_gaussians_are_rendered_and_have_gradients(in_double):
    single = {"dtype": torch.float32}
    splats = warpgs.Splats(
        means=torch.zeros(1, 3, **single, requires_grad=True),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], **single),
        scales=torch.full((1, 3), 0.5, **single),
        opacities=torch.full((1,), 0.8, **single),
        colors=torch.rand(1, 3, **single),
    )
    camera = warpgs.Camera.looking_at([0.1, 0, -4], [0, 0, 0], [0, -1, 0], 80, (96, 64))
    layer = warpgs.render(splats, camera, settings=warpgs.RenderSettings(depth=True, antialias=True)).joint
    (layer.image.sum() + layer.depth.square().sum()).backward()
    assert layer.image.dtype == layer.depth.dtype == splats.means.grad.dtype == torch.float32
    assert splats.means.grad.norm() > 0


@pytest.mark.parametrize("net", ["alex", "squeeze", "vgg"])
def test_lpips_compares_images(in_double, net):
    image = torch.rand(40, 40, 3, dtype=torch.float32)
    assert Lpips(net)(image, image.flip(0)).dtype == torch.float32


@pytest.mark.parametrize("preset", ["tiny", "best"])
def test_a_training_has_the_same_bits(data, tmp_path, monkeypatch, in_double, preset):
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    config = dataclasses.replace(tiny.CONFIG, data=data)
    if preset == "best":  # with what a capture needs: poses, exposure, depth by size
        optim = dataclasses.replace(config.optim, poses=1e-3)
        loss = PRESETS["best"].loss
        config = dataclasses.replace(config, exposure=True, background="mean", optim=optim, loss=loss)
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        warpgs.train(dataclasses.replace(config, out=tmp_path / str(dtype)))
    runs = [tmp_path / str(dtype) for dtype in (torch.float32, torch.float64)]
    assert tiny.differences(tiny.state(runs[0]), tiny.state(runs[1])) == []
    tensors = checkpoint.load(checkpoint.list_checkpoints(runs[1])[-1]).tensors.values()
    assert {t.dtype for t in tensors if t.is_floating_point()} == {torch.float32}


def test_a_built_in_capture_has_the_same_bits(data, tmp_path, in_double):
    again = tiny.write(tmp_path)
    files = [path.relative_to(data) for path in data.rglob("*") if path.is_file()]
    assert files
    assert all((again / path).read_bytes() == (data / path).read_bytes() for path in files)
