"""A capture under a sky trains with it behind its Gaussians; any other capture as if there were no such thing."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch

from tests import plain, tiny
from tests.lens_captures import CAMERAS, recorded
from warpgs.captures.opening import load_capture
from warpgs.evaluation import evaluate_run
from warpgs.evaluation.image_quality import psnr
from warpgs.initialization.prepare_start import prepare_start
from warpgs.model.dome import Dome
from warpgs.rendering import Layer, Rendering
from warpgs.runs import checkpoint
from warpgs.runs.opening import open_run
from warpgs.runs.run import Run
from warpgs.synthetic.studio import BASELINE, MAX_DEPTH, StudioSize, studio_capture, trace
from warpgs.training.train import make_trainer, train
from warpgs.video import frames
from warpgs.video.options import Render

SIZE = StudioSize(width=64, height=36, num_frames=8, num_samples=2, num_points=600)
CONFIG = dataclasses.replace(tiny.CONFIG, background="auto")


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    return studio_capture("exact", tmp_path_factory.mktemp("cache"), SIZE, quiet=True, sky=True)


@pytest.fixture(scope="module")
def run(outside, tmp_path_factory, quickly):
    return finished(outside, tmp_path_factory.mktemp("sky") / "run")


def finished(data, out, **changes):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
        train(dataclasses.replace(CONFIG, data=data, out=out, **changes))
    return out


def last(run):
    return checkpoint.load(checkpoint.path_of(run, tiny.LENGTH)).tensors


@pytest.mark.usefixtures("quickly")
def test_a_resumed_run_under_a_sky_continues_bit_for_bit(run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    for path in checkpoint.list_checkpoints(copy):
        if int(path.stem) > 14:
            path.unlink()
    trainer = make_trainer(dataclasses.replace(CONFIG, resume=copy))
    assert trainer.iteration == 14
    assert isinstance(trainer.scene.dome, Dome)
    tiny.train(trainer)
    whole, again = last(run), last(copy)
    assert {"scene.dome.texels", "scene.dome.far", "adam.exp_avg.dome.texels"} <= set(whole)
    assert whole.keys() == again.keys()
    assert all(torch.equal(whole[name], again[name]) for name in whole)


def test_training_changes_the_sky_where_frames_show_it_and_nowhere_else(run, outside):
    before = checkpoint.load(checkpoint.path_of(run, 0)).tensors["scene.dome.texels"]
    changed = (before != last(run)["scene.dome.texels"]).any(0)
    assert 0.01 < changed.float().mean() < 0.3
    capture, shown = load_capture(outside), Dome(changed.float()[None].repeat(3, 1, 1))
    with torch.no_grad():
        images = torch.stack([shown(capture.cameras[name]) for name in capture.train])
    assert images[:, :4].mean() > 0.5
    assert images[:, -8:].mean() < 0.05


def test_a_run_under_a_sky_is_rendered_over_it(run):
    scene = open_run(run, "cpu")
    assert scene.config.background == "sky"
    camera = scene.open_capture(quiet=True).cameras["right_000004"]
    layers = scene.render(camera, branches=True)
    expected = scene.scene.dome(camera)
    for layer in layers[:3]:
        clear = layer.alpha < 1e-4
        assert clear.any()
        assert torch.allclose(layer.image[clear], expected[clear], atol=1e-3)
    assert torch.equal(scene.play(camera), layers.joint.image)
    kept = torch.ones(len(scene.scene.static) + len(scene.scene.dynamic), dtype=torch.bool)
    assert torch.equal(scene.select(kept).render(camera).joint.image, layers.joint.image)


def test_a_transparent_image_has_nothing_of_the_sky(run):
    scene = open_run(run, "cpu")
    camera = scene.open_capture(quiet=True).cameras["right_000004"]
    (image,) = frames._images(Render(run, transparent=True), scene, camera, None)
    layer = scene.render(camera).joint
    assert torch.allclose(image[..., 3], layer.alpha, atol=1e-6)
    clear = layer.alpha < 1e-6
    assert clear.any()
    assert image[clear].abs().max() < 0.05


@pytest.mark.usefixtures("quickly")
def test_a_capture_without_a_sky_trains_as_before_there_was_one(tmp_path, data):
    checkpoints = []
    for background in ("auto", "mean"):
        out = tmp_path / background
        Run.create(out, plain.plan(tiny.CONFIG))
        trainer = tiny.trainer(data, out, dataclasses.replace(tiny.CONFIG, background=background))
        assert trainer.scene.dome is None
        tiny.train(trainer)
        checkpoints.append(last(out))
    assert checkpoints[0].keys() == checkpoints[1].keys()
    assert not any("dome" in name for name in checkpoints[0])
    assert all(torch.equal(tensor, checkpoints[1][name]) for name, tensor in checkpoints[0].items())


def test_a_checkpoint_without_the_sky_of_its_run_is_refused(run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    path = checkpoint.path_of(copy, tiny.LENGTH)
    loaded = checkpoint.load(path)
    kept = {name: tensor for name, tensor in loaded.tensors.items() if not name.startswith("scene.dome")}
    checkpoint.save(path, kept, loaded.metadata)
    with pytest.raises(ValueError, match=r"does not hold a scene of this run's config: Missing key.*dome"):
        open_run(copy, "cpu")


@pytest.mark.usefixtures("quickly")
def test_held_out_views_show_the_sky_better_than_gaussians_in_its_place(outside, run, tmp_path):
    over_color = finished(outside, tmp_path / "mean", background="mean")
    quality = []
    for folder in (run, over_color):
        scene = open_run(folder, "cpu")
        frames = [*scene.open_capture(quiet=True).frames(["right_000002", "right_000006"])]
        skies = [trace(frame.camera.time, BASELINE, SIZE, sky=True)[1] > MAX_DEPTH for frame in frames]
        images = [(scene.render(frame.camera).joint.image, frame.image / 255.0) for frame in frames]
        quality.append(sum(psnr(*pair, sky) for pair, sky in zip(images, skies, strict=True)) / 2)
    assert quality[0] > quality[1] + 5.0


@pytest.mark.usefixtures("quickly")
def test_a_step_looks_at_the_sky_through_the_lens_of_its_view(tmp_path):
    capture = recorded("fisheye")
    camera = dataclasses.replace(capture.cameras[capture.train[1]], distortion=CAMERAS["radial"].distortion)
    capture = capture.with_cameras({capture.train[1]: camera})
    trainer = tiny.Trainer(prepare_start(dataclasses.replace(CONFIG, background="sky"), capture), tmp_path)
    step, dome = trainer.step, trainer.scene.dome
    for index in range(3):
        step.views.select(index)
        view = step.views.selected()
        empty = torch.zeros(view.camera.height, view.camera.width)
        layer = Layer(torch.zeros(*empty.shape, 3), empty, None)
        seen = step._under_sky(dome, Rendering(layer, layer, layer, *4 * [None]), view)
        expected = dome(capture.cameras[capture.train[index]])
        assert torch.allclose(seen.joint.image, expected, atol=1e-4)
        assert torch.equal(seen.static.image, seen.joint.image)
        assert not seen.dynamic.image.any()
        dome.texels.grad = None
        seen.joint.image.sum().backward()
        assert dome.texels.grad.any()
