"""Evaluation: metrics recomputed here from known images."""

import csv
import dataclasses
import functools
import json
import math
import re
import shutil
import statistics
import subprocess
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import scipy.optimize
import torch

from tests import tiny
from tests.data.captures import write_png
from tests.scenes import along_z
from warpgs.captures.opening import load_capture, open_capture
from warpgs.data.capture import Capture, Frame
from warpgs.data.lens import Lens
from warpgs.evaluation import evaluate, evaluate_run, scene_metrics
from warpgs.evaluation.evaluate import Evaluation, ViewMetrics
from warpgs.evaluation.lpips import Lpips
from warpgs.files import write_json
from warpgs.rendering import Layer, Rendering
from warpgs.runs import checkpoint
from warpgs.runs.opening import open_run
from warpgs.runs.trained import TrainedScene
from warpgs.training.train import train
from warpgs.video.camera_paths import training_path

H, W = 12, 16
CPU = torch.device("cpu")
VAL = ("a", "b", "c")


def frame(name, time, masks=True, covisible=False):
    camera = along_z(20.0, (W, H), time=time)
    static, seen = torch.ones(H, W, dtype=torch.bool), torch.zeros(H, W, dtype=torch.bool)
    static[:4], seen[:, :5] = False, True
    image = torch.randint(0, 256, (H, W, 3), dtype=torch.uint8)
    return Frame(name, camera, image, static if masks else None, None, seen if covisible else None)


def capture(val=VAL, **options):
    """Training frames at times 0 and 1, evaluation frames between them."""
    times = {"first": 0.0, "last": 1.0, **{name: (k + 1) / 4 for k, name in enumerate(val)}}
    frames = {name: frame(name, time, **options) for name, time in times.items()}
    cameras = {name: f.camera for name, f in frames.items()}
    return Capture("here", cameras, ["first", "last"], val, torch.zeros(0, 3), None, frames.__getitem__)


def rendering(image, dynamic_alpha=None):
    alpha = torch.zeros(image.shape[:2]) if dynamic_alpha is None else dynamic_alpha
    joint, dynamic = Layer(image, torch.ones_like(alpha), None), Layer(torch.zeros_like(image), alpha, None)
    return Rendering(joint, joint, dynamic, torch.zeros(0, 2).int(), None, None, None)


class Scene:
    """A scene whose renderings are those of a function of camera and branches."""

    device = CPU

    def __init__(self, render):
        self.render = lambda camera, branches=False: render(camera, branches)

    def play(self, camera):
        return self.render(camera).joint.image


def images_at(images):
    """Renders the image that belongs to a camera's time."""
    return Scene(lambda camera, branches: rendering(images[camera.time]))


def noisy(capture, spread=0.1):
    """Renderings of the evaluation frames that are off by different amounts."""
    images = {}
    for k, name in enumerate(capture.val):
        truth = capture.frame(name).image.double() / 255
        images[capture.cameras[name].time] = (truth + (k + 1) * spread * torch.randn(H, W, 3).double()).float()
    return images


def evaluated(capture, images, **options):
    return evaluate.evaluate(images_at(images), capture, quiet=True, **options)


def decibels(capture, images, name, rows=slice(None), columns=slice(None)):
    """−10 log₁₀ of the mean squared error within rows and columns, in NumPy."""
    truth = capture.frame(name).image.numpy().astype(np.float64) / 255
    image = images[capture.cameras[name].time].numpy().clip(0, 1)
    return -10 * math.log10(((image - truth)[rows, columns] ** 2).mean())


def test_psnr_is_the_mean_over_views_of_each_views_psnr():
    """Not the PSNR of the mean error, which one bad view would rule."""
    here = capture()
    images = noisy(here)
    expected = [decibels(here, images, name) for name in VAL]
    result = evaluated(here, images)
    assert [view.values["psnr"] for view in result.views] == pytest.approx(expected, abs=1e-3)
    assert result.summary()["psnr"] == pytest.approx(sum(expected) / 3, abs=1e-3)


def test_static_and_dynamic_psnr_are_those_of_the_masks_regions():
    here = capture()
    images = noisy(here)
    for view in evaluated(here, images).views:
        assert view.values["psnr_dynamic"] == pytest.approx(
            decibels(here, images, view.name, rows=slice(0, 4)), abs=1e-3
        )
        assert view.values["psnr_static"] == pytest.approx(
            decibels(here, images, view.name, rows=slice(4, None)), abs=1e-3
        )


def test_masked_psnr_is_that_of_the_covisible_pixels():
    here = capture(covisible=True)
    images = noisy(here)
    for view in evaluated(here, images).views:
        assert view.values["masked_psnr"] == pytest.approx(
            decibels(here, images, view.name, columns=slice(0, 5)), abs=1e-3
        )


def test_masked_ssim_does_not_see_what_is_not_covisible():
    here = capture(covisible=True)
    images = noisy(here)
    spoilt = {time: torch.cat([image[:, :5], torch.rand(H, W - 5, 3)], 1) for time, image in images.items()}
    wanted = [view.values["masked_ssim"] for view in evaluated(here, images).views]
    assert [view.values["masked_ssim"] for view in evaluated(here, spoilt).views] == wanted


def test_values_outside_0_and_1_count_as_0_and_1():
    here = capture()
    images = noisy(here, spread=2.0)
    clamped = {time: image.clamp(0, 1) for time, image in images.items()}
    assert any(bool((image < 0).any() and (image > 1).any()) for image in images.values())
    assert evaluated(here, images).views == evaluated(here, clamped).views


def test_what_a_capture_does_not_have_is_not_measured():
    view = evaluated(capture(masks=False), noisy(capture())).views[0]
    regions = "psnr_static psnr_dynamic ssim_static ssim_dynamic masked_psnr masked_ssim masked_lpips"
    for name in (*regions.split(), "lpips", "ms_ssim"):
        assert view.values[name] is None


def test_a_region_of_no_pixel_is_not_measured():
    here = capture()
    for name in VAL:
        here.frame(name).static_mask.fill_(True)
    assert all(view.values["psnr_dynamic"] is None for view in evaluated(here, noisy(here)).views)


def view_of(name, **values):
    return ViewMetrics(name, 0.0, {**dict.fromkeys(evaluate.of_views()), "psnr": 20.0, "ssim": 0.5, **values})


def test_a_mean_leaves_out_views_that_were_not_measured():
    views = [view_of("a", psnr_static=10.0), view_of("b"), view_of("c", psnr_static=30.0)]
    assert Evaluation(views, {}, None).summary()["psnr_static"] == 20.0


def test_each_view_is_shown_once_in_order():
    shown = []
    here = capture()
    evaluated(here, noisy(here), on_view=lambda index, frame, truth, rendering: shown.append((index, frame.name)))
    assert shown == [(0, "a"), (1, "b"), (2, "c")]


def test_lpips_is_measured_with_the_network_that_is_given():
    class Half(Lpips):
        def forward(self, image, truth):
            return (image - truth).abs().mean() / 2

        def masked(self, image, truth, region):
            return (image - truth).abs()[region].mean() / 2

    here = capture(covisible=True)
    images = noisy(here)
    result = evaluated(here, images, lpips=Half("squeeze"))
    truth = here.frame("b").image.float() / 255
    assert result.lpips_net == "squeeze"
    error = (images[0.5].clamp(0, 1) - truth).abs()
    assert result.views[1].values["lpips"] == pytest.approx((error.mean() / 2).item())
    assert result.views[1].values["masked_lpips"] == pytest.approx((error[:, :5].mean() / 2).item())


LENS = Lens(30, 22, (31.0, 29.0), (15.6, 10.3), (-0.14, 0.05, 0.006, -0.004))


def pattern(x, y):
    """A smooth image of the plane z = 1."""
    waves = (torch.sin(9 * x + 4 * y), torch.cos(7 * y), torch.sin(8 * x))
    return 0.5 + 0.4 * torch.stack(waves, 2)


def ray_at(u, v):
    """The x, y on the plane z = 1 whose image is a pixel of ``LENS``, by the solver of SciPy."""
    start = [(u - LENS.center[0]) / LENS.focal[0], (v - LENS.center[1]) / LENS.focal[1]]
    found = scipy.optimize.root(lambda p: LENS.image(np.array(p[0]), np.array(p[1])) - [u, v], start)
    assert found.success
    return found.x


@functools.cache
def distorted_capture():
    """One evaluation frame of the pattern through ``LENS``."""
    pixels = [[ray_at(j + 0.5, i + 0.5) for j in range(LENS.width)] for i in range(LENS.height)]
    x, y = torch.tensor(np.array(pixels), dtype=torch.float32).unbind(2)
    camera, everywhere = LENS.camera(np.eye(3), np.zeros(3), 0.5), torch.ones(x.shape, dtype=torch.bool)
    frames = {"a": Frame("a", camera, (pattern(x, y) * 255).round().byte(), everywhere)}
    return Capture("here", {"a": camera}, ["a"], ["a"], torch.zeros(0, 3), None, frames.__getitem__)


def pattern_through(camera, branches):
    x, y, _ = camera.rays(camera.pixel_centers).reshape(camera.height, camera.width, 3).unbind(2)
    return rendering(pattern(x, y))


def test_frames_are_compared_as_they_were_recorded():
    """What is left is the rounding to 8 bits."""
    shown = []
    result = evaluate.evaluate(
        Scene(pattern_through), distorted_capture(), on_view=lambda *v: shown.append(v), quiet=True
    )
    assert result.views[0].values["psnr"] > 58.0
    assert torch.equal(shown[0][2], distorted_capture().frame("a").image.float() / 255)


def test_the_check_of_the_views_keeps_none_in_memory():
    read, here = [], capture()
    frames = here.read
    here = dataclasses.replace(here, read=lambda name: read.append(name) or frames(name))
    evaluate.check_views(here)
    assert sorted(read) == sorted(VAL)
    assert [here.frame(name).name for name in VAL] == read[len(VAL) :] == list(VAL)


@pytest.mark.parametrize("quiet", [True, False])
def test_the_check_of_the_views_shows_progress_unless_quiet(monkeypatch, quiet):
    shown = []
    monkeypatch.setattr(evaluate, "progress", lambda items, label, quiet: shown.append((label, quiet)) or items)
    evaluate.check_views(capture(), quiet=quiet)
    assert shown == [("reading evaluation frames", quiet)]


def gray(value):
    return torch.full((H, W, 3), value)


def test_flicker_is_the_mean_change_between_consecutive_times():
    images = {0.25: gray(0.2), 0.5: gray(0.5), 0.75: gray(0.4)}
    assert evaluated(capture(), images).scene["flicker"] == pytest.approx((0.3 + 0.1) / 2)


def test_flicker_uses_only_the_middle_camera():
    here = capture()
    for k, name in enumerate(VAL):
        here.cameras[name].viewmat[0, 3] = k
    seen = []

    def render(camera, branches):
        if branches:
            seen.append((camera.viewmat[0, 3].item(), camera.time))
        return rendering(gray(0.5))

    evaluate.evaluate(Scene(render), here, quiet=True)
    assert seen[len(VAL) :] == [(1.0, 0.25), (1.0, 0.5), (1.0, 0.75)]


def test_flicker_omits_pixels_that_are_dynamic_at_either_time():
    def render(camera, branches):
        alpha = torch.zeros(H, W)
        image = gray(0.5)
        if camera.time == 0.5:
            alpha[:3], image[:3] = 1.0, 1.0
        return rendering(image, alpha)

    assert evaluate.evaluate(Scene(render), capture(), quiet=True).scene["flicker"] == 0.0


@pytest.mark.parametrize("val", [("a",), ()])
def test_flicker_needs_two_times(val):
    here = capture(val)
    for camera in here.cameras.values():
        object.__setattr__(camera, "time", 0.25)
    assert evaluated(here, {0.25: gray(0.5)}).scene["flicker"] is None


def test_flicker_is_not_measured_if_everything_is_dynamic():
    def render(camera, branches):
        return rendering(gray(camera.time), torch.ones(H, W))

    assert evaluate.evaluate(Scene(render), capture(), quiet=True).scene["flicker"] is None


def test_fps_counts_joint_images_after_one_warm_up_frame(monkeypatch):
    now = [0.0]

    def render(camera, branches):
        now[0] += 0.0 if branches else (100.0 if now[0] == 0.0 else 0.02)
        return rendering(gray(0.5))

    monkeypatch.setattr(scene_metrics.time, "perf_counter", lambda: now[0])
    assert evaluate.evaluate(Scene(render), capture(), quiet=True).scene["fps"] == pytest.approx(50.0)


def test_without_evaluation_frames_only_flicker_and_speed_are_measured():
    summary = evaluated(capture(()), {0.0: gray(0.2), 1.0: gray(0.4)}).summary()
    assert (summary["psnr"], summary["ssim"], summary["lpips"], summary["num_views"]) == (None, None, None, 0)
    assert summary["flicker"] == pytest.approx(0.2)
    assert summary["fps"] > 0


def test_each_view_is_a_line_with_empty_fields_for_unmeasured_metrics(tmp_path):
    views = [view_of("a,b", psnr_static=12.5), view_of("c")]
    evaluate.write_views(tmp_path / "views.csv", Evaluation(views, {}, None))
    with open(tmp_path / "views.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    found = [(row["name"], row["psnr"], row["psnr_static"]) for row in rows]
    assert found == [("a,b", "20.0", "12.5"), ("c", "20.0", "")]


@pytest.fixture(scope="module")
def run(quickly, data, tmp_path_factory):
    """A run of train.py with its evaluation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
        patch.setattr(evaluate_run, "device_name", lambda device: f"name of {device}")
        config = dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path_factory.mktemp("runs") / "run")
        train(config)
    return config.out


@pytest.fixture
def metrics(run):
    return json.loads((run / "metrics.json").read_text())


def test_metrics_have_every_field_that_reports_need(metrics):
    wanted = "psnr ssim lpips psnr_static psnr_dynamic flicker jitter fps train_seconds num_static num_dynamic"
    assert {*wanted.split(), "iterations", "device", "commit"} <= metrics.keys()


def test_metrics_are_those_of_the_last_checkpoint(metrics, run):
    state = tiny.state(run)
    assert metrics["iterations"] == tiny.LENGTH
    assert metrics["num_static"] == len(state["scene.static.means"]) > 0
    assert metrics["num_dynamic"] == len(state["scene.dynamic.means"]) > 0
    assert 0 < metrics["train_seconds"] < 600
    assert metrics["fps"] > 0


def test_metrics_name_the_processor_that_rendered(metrics):
    assert metrics["device"] == "name of cpu"


def test_metrics_name_the_commit_of_a_checkout(metrics):
    root = Path(evaluate_run.__file__).parent
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
    if head.returncode:
        assert metrics["commit"] is None
    else:
        assert re.fullmatch("[0-9a-f]{7,}", metrics["commit"])
        assert head.stdout.startswith(metrics["commit"])


@pytest.mark.parametrize(("num_views", "shown"), [(1, "1 view: PSNR"), (3, "3 views: PSNR")])
def test_the_summary_counts_one_view_in_the_singular(metrics, num_views, shown):
    assert evaluate_run._summary({**metrics, "num_views": num_views}).startswith(shown)


def test_metrics_are_the_means_of_the_views(metrics, run):
    with open(run / "views.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == metrics["num_views"] == 3
    for name in ("psnr", "ssim", "psnr_static", "psnr_dynamic"):
        assert metrics[name] == pytest.approx(statistics.fmean(float(row[name]) for row in rows))


def test_views_without_any_error_are_numbers_in_json_and_in_the_table(tmp_path):
    here = capture(("a",))
    result = evaluated(here, {0.25: here.frame("a").image.float() / 255})
    write_json(tmp_path / "metrics.json", result.summary())
    evaluate.write_views(tmp_path / "views.csv", result)
    assert 58.0 < json.loads((tmp_path / "metrics.json").read_text())["psnr"] < 59.0
    assert "inf" not in (tmp_path / "views.csv").read_text()


def test_the_video_over_time_follows_the_training_camera(run, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 3)
    here, seen = open_capture(open_run(run).config), []
    layer = SimpleNamespace(image=torch.zeros(8, 8, 3))
    rendered = SimpleNamespace(joint=layer, static=layer, dynamic=layer)
    monkeypatch.setattr(TrainedScene, "render", lambda self, camera, **options: seen.append(camera) or rendered)
    evaluate_run._write_video(tmp_path / "time.mp4", open_run(run), here, quiet=True)
    recorded = training_path(here, 3)
    assert [camera.time for camera in seen] == [0.0, 0.5, 1.0]
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(seen, recorded, strict=True))


def test_changed_images_of_a_capture_are_read_again(run, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    data, copy = tiny.write(tmp_path), shutil.copytree(run, tmp_path / "copy")
    before = json.loads((run / "metrics.json").read_text())["psnr"]
    for path in (data / "rgb/1x").iterdir():
        write_png(path, np.zeros((tiny.SCENE.height, tiny.SCENE.width, 3), np.uint8))
    evaluate_run.evaluate_run(copy, open_capture(dataclasses.replace(tiny.CONFIG, data=data)), quiet=True)
    assert json.loads((copy / "metrics.json").read_text())["psnr"] != pytest.approx(before)


def test_a_run_is_not_evaluated_at_other_times_than_those_it_was_trained_at(finished_run, tmp_path):
    run = shutil.copytree(finished_run, tmp_path / "run")
    path = checkpoint.list_checkpoints(run)[-1]
    tiny.edit_metadata(path, lambda values: values.update(times=[time / 2 for time in values["times"]]))
    with pytest.raises(ValueError, match=r"^frame \S+ of builtin had time \S+ in training and has \S+ now: "):
        evaluate_run.evaluate_run(run, quiet=True)


def test_metrics_are_written_even_if_the_video_cannot_be(finished_run, tmp_path, monkeypatch):
    run = shutil.copytree(finished_run, tmp_path / "run")
    for name in ("metrics.json", "views.csv"):
        (run / name).unlink(missing_ok=True)
    monkeypatch.setattr(av, "codecs_available", set())
    with pytest.raises(OSError, match="has no libx264"):
        evaluate_run.evaluate_run(run, load_capture(tiny.write(tmp_path)), quiet=True)
    assert json.loads((run / "metrics.json").read_text())["psnr"] > 0
    assert len((run / "views.csv").read_text().splitlines()) > 1
