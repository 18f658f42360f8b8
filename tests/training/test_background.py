"""Training composites over a background, and whatever opens the run has it: white, the mean colour of frames, any."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests import plain, tiny
from tests.data.captures import edit_json
from warpgs.captures.opening import load_capture
from warpgs.config import TrainConfig, validate
from warpgs.evaluation import evaluate_run
from warpgs.export.clouds import Clouds
from warpgs.export.start_camera import start_view
from warpgs.files import write_png
from warpgs.initialization import plan as module
from warpgs.initialization.plan import make_plan, mean_color
from warpgs.rendering import Layer
from warpgs.runs.opening import open_run
from warpgs.runs.run import Run
from warpgs.synthetic.balls import BallsSize, balls_capture
from warpgs.training.command import parse
from warpgs.training.train import make_trainer, train
from warpgs.video import frames
from warpgs.video.options import Render
from warpgs.views.views import Views

WHITE = (1.0, 1.0, 1.0)


def finished(data, out, **changes):
    """The folder of a finished run on a capture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
        train(dataclasses.replace(tiny.CONFIG, data=data, out=out, checkpoint_every=30, **changes))
    return out


@pytest.fixture(scope="module")
def run(tmp_path_factory, quickly):
    """A finished run on a small capture over white; its folder has the capture as well."""
    folder = tmp_path_factory.mktemp("run")
    data = balls_capture(folder / "cache", BallsSize(side=16, num_frames=8, num_val=2), quiet=True)
    return finished(data, folder / "run")


@pytest.fixture
def capture(run):
    """The capture of the run over white."""
    return load_capture(Run.open(run, "cpu").config.data)


@pytest.fixture
def opaque(run, tmp_path):
    """A copy of the run whose capture has lost its alpha."""
    data = shutil.copytree(Run.open(run, "cpu").config.data, tmp_path / "balls")
    for path in data.rglob("*.png"):
        write_png(path, np.ascontiguousarray(cv2.imread(str(path))[..., ::-1]))
    copy = shutil.copytree(run, tmp_path / "run")
    edit_json(copy / "config.json", data=str(data))
    return copy


@pytest.fixture
def older(run, tmp_path):
    """A copy of the run as if it had been made before runs had a background."""
    copy = shutil.copytree(run, tmp_path / "older")
    edit_json(copy / "config.json", background=None)
    return copy


def background_of(config, capture):
    """The background of a run that is begun with a config."""
    return make_plan(config, capture)[0].background


def backgrounds(trainer):
    """What the next step composites behind the joint, the static and the dynamic image."""
    trainer.step(trainer.protocol.at(trainer.iteration), trainer._sample(trainer.protocol.at(trainer.iteration)))
    return trainer.step._backgrounds()


def resumed(run):
    """A trainer that continues the run, two iterations before its end."""
    (run / "checkpoints" / f"{tiny.LENGTH:07d}.safetensors").unlink()
    return make_trainer(TrainConfig(resume=run, device="cpu"))


def test_a_run_renders_over_the_background_of_its_capture(run):
    scene = open_run(run, "cpu")
    assert scene.config.background == "white"
    capture = load_capture(scene.config.data)
    rendering = scene.render(capture.cameras[capture.val[0]], branches=True)
    for layer in (rendering.joint, rendering.static, rendering.dynamic):
        clear = layer.alpha < 1e-3
        assert clear.any()
        assert (layer.image[clear] > 0.99).all()


def test_metrics_are_finite_where_the_background_is_all_there_is(run):
    metrics = json.loads((run / "metrics.json").read_text())
    assert 0 < metrics["psnr_dynamic"] < metrics["psnr_static"] < 59


def test_a_run_keeps_its_background_when_the_capture_has_lost_its_alpha(opaque):
    capture = Run.open(opaque, "cpu").open_capture()
    assert load_capture(Run.open(opaque, "cpu").config.data).background == "black"
    assert capture.background == "white"
    assert torch.equal(backgrounds(resumed(opaque)), torch.ones(3, 3))


def test_a_run_without_a_background_stays_over_black_with_empty_pixels_to_paint(older):
    scene = open_run(older, "cpu")
    capture = scene.open_capture()
    layer = scene.render(capture.cameras[capture.val[0]]).joint
    clear = layer.alpha < 1e-3
    assert clear.any()
    assert (layer.image[clear] < 0.01).all()
    frame = capture.frame(capture.val[0])
    assert frame.empty is None
    assert not frame.static_mask.any()
    trainer = resumed(older)
    assert torch.equal(backgrounds(trainer)[:2], torch.zeros(2, 3))
    assert not trainer.views[0].static_mask.any()


@pytest.mark.parametrize("asked", ["black", "white"])
def test_an_option_overrides_the_background_of_the_capture(capture, asked):
    assert background_of(plain.config(background=asked), capture) == asked
    assert background_of(plain.config(), capture) == "white"
    assert (capture.over(asked).frame("train_r_000").empty is None) == (asked == "black")


def test_exact_masks_have_no_margin(capture):
    frame = capture.frame("train_r_000")
    given = dataclasses.replace(capture, read=lambda name: frame, unmasked="masks")  # the same masks, from files
    for source, has_border in ((capture, False), (given, True)):
        view = Views(source, torch.device("cpu"), 1 << 30, mask_margin=0.1)[0]
        assert torch.equal(view.static_mask, frame.static_mask)
        assert bool(view.mask_border.any()) == has_border


@pytest.mark.parametrize("background", [WHITE, (0.6, 0.5, 0.4)])
def test_a_transparent_image_has_none_of_the_background(background):
    color, alpha, behind = torch.rand(4, 5, 3), 0.2 + 0.8 * torch.rand(4, 5), torch.tensor(background)
    layer = Layer(color * alpha[..., None] + (1.0 - alpha[..., None]) * behind, alpha, None)
    rgba = frames._pixels(layer, Render(Path("run"), transparent=True), behind)
    assert torch.allclose(rgba, torch.cat([color, alpha[..., None]], -1), atol=1e-5)
    assert torch.equal(frames._pixels(layer, Render(Path("run")), behind), layer.image)


def test_a_page_starts_over_the_background(run, mean_run):
    for folder in (run, mean_run):
        scene = open_run(folder, "cpu")
        expected = WHITE if folder == run else scene.config.background
        assert start_view(Clouds(scene), None, keys=2, seconds=1.0).background == expected


def test_a_capture_without_a_background_has_black_behind_it(tmp_path):
    trainer = tiny.trainer(tiny.write(tmp_path), tmp_path / "run")
    assert trainer.capture.background == "black"
    assert torch.equal(backgrounds(trainer)[:2], torch.zeros(2, 3))


def test_the_psnr_of_training_is_finite_where_nothing_is_wrong(run, tmp_path):
    trainer = resumed(shutil.copytree(run, tmp_path / "run"))
    trainer.views._all.image.fill_(255)
    with torch.no_grad():
        trainer.scene.dynamic.logit_opacities.fill_(-20.0)
    backgrounds(trainer)
    assert trainer.step.take_means().psnr == pytest.approx(58.9, abs=0.05)


@pytest.fixture(scope="module")
def mean_run(tmp_path_factory, quickly):
    """A finished run on a small capture without a background of its own, over the mean colour of its frames."""
    folder = tmp_path_factory.mktemp("mean")
    return finished(tiny.write(folder), folder / "run", background="mean")


def mean_of(capture):
    """Mean colour of all training frames."""
    return torch.stack([capture.frame(name).image.double() / 255.0 for name in capture.train]).mean((0, 1, 2))


def test_the_mean_background_is_the_mean_colour_of_the_training_frames(mean_run):
    scene = open_run(mean_run, "cpu")
    capture = scene.open_capture()
    mean = mean_of(capture)
    assert mean.min() > 0.05
    assert mean.max() < 0.95
    assert scene.config.background == pytest.approx(mean.tolist(), abs=6e-4)
    assert capture.background == scene.config.background
    assert scene.background.tolist() == pytest.approx(mean.tolist(), abs=6e-4)
    viewmat = torch.eye(4)
    viewmat[2, 3] = -1e4  # the whole scene is far behind the camera
    empty = scene.render(dataclasses.replace(capture.cameras[capture.val[0]], viewmat=viewmat)).joint
    assert (empty.alpha == 0).all()
    assert torch.allclose(empty.image, scene.background.expand_as(empty.image))


def test_the_dynamic_image_is_trained_over_a_random_color_where_the_others_are_over_the_mean(mean_run, tmp_path):
    trainer = resumed(shutil.copytree(mean_run, tmp_path / "run"))
    color = trainer._sample(trainer.protocol.at(trainer.iteration)).color
    joint, static, dynamic = backgrounds(trainer)
    assert joint.tolist() == static.tolist() == pytest.approx(list(trainer.config.background))
    assert dynamic.tolist() == pytest.approx(color)


@pytest.mark.parametrize("name", ["run", "mean_run"])
def test_a_resumed_run_goes_on_as_it_would_have(name, request, tmp_path):
    whole = request.getfixturevalue(name)
    copy = shutil.copytree(whole, tmp_path / "run")
    trainer = resumed(copy)
    assert trainer.iteration < tiny.LENGTH
    assert tiny.train(trainer)
    assert tiny.differences(tiny.state(copy), tiny.state(whole)) == []


def test_a_capture_over_white_stays_so_where_others_get_the_mean(capture):
    assert background_of(plain.config(background="mean"), capture) == "white"
    assert background_of(plain.config(background="mean"), capture.over("black")) == mean_color(capture)


def test_the_mean_of_many_frames_is_that_of_some_of_them(capture, monkeypatch):
    everything = mean_color(capture)
    monkeypatch.setattr(module, "MAX_AVERAGED", 2)
    assert mean_color(capture) != everything
    assert mean_color(capture) == pytest.approx(everything, abs=0.1)


@pytest.mark.parametrize("color", [[0.1, 0.2], [0.1, 0.2, 1.5], [0.1, 0.2, "0.3"], [0.1, 0.2, float("nan")], "grey"])
def test_a_background_that_is_no_colour_is_refused(mean_run, tmp_path, color):
    damaged = shutil.copytree(mean_run, tmp_path / "run")
    edit_json(damaged / "config.json", background=color)
    with pytest.raises(ValueError, match=r"config\.json: background"):
        open_run(damaged, "cpu")


@pytest.mark.parametrize(
    ("words", "expected"), [("0.1 0.2 0.3", (0.1, 0.2, 0.3)), ("1 1 1", "white"), ("0 0 0", "black")]
)
def test_a_background_may_be_given_in_rgb(capture, words, expected):
    config = parse(["--data", "x", "--background", *words.split()])
    assert background_of(config, capture) == expected


@pytest.mark.parametrize("background", ["grey", [0.1, 0.2, 0.3], (0.5, 0.5), (0.5, 0.5, 1.5), 0.5])
def test_a_background_that_is_no_colour_is_refused_before_training(background):
    with pytest.raises(ValueError, match="background must be auto, sky, mean, capture, black, white, or three numbers"):
        validate(plain.config(background=background))
