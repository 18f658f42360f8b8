"""Training copes with incomplete captures and with failures, or reports them in words."""

import dataclasses
import json
import runpy
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from tests import tiny
from tests.data.captures import edit_json, write_png
from warpgs.evaluation import evaluate_run, scene_metrics
from warpgs.runs import checkpoint
from warpgs.runs.logger import TrainingLogger
from warpgs.training import command, losses
from warpgs.training import train as script
from warpgs.training.step import Step
from warpgs.training.trainer import MAX_ROLLBACKS

pytestmark = pytest.mark.usefixtures("quickly")

SCRIPT = str(Path(__file__).parents[2] / "train.py")


@pytest.fixture
def data(data, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(data, tmp_path / "capture")


@pytest.fixture
def run(tmp_path):
    return tmp_path / "run"


def is_finite(run):
    return all(bool(torch.isfinite(t).all()) for name, t in tiny.state(run).items() if name.startswith("scene."))


def end_to_end(data, run, monkeypatch, capsys, **changes):
    """Output and metrics of ``train.py``."""
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    monkeypatch.setattr(scene_metrics, "TIMED_FRAMES", 2)
    # Without opacity resets, after which large Gaussians are removed: without depth or points they start large.
    schedule = dataclasses.replace(tiny.SCHEDULE, reset_every=tiny.LENGTH)
    config = dataclasses.replace(tiny.CONFIG, data=data, out=run, schedule=schedule, **changes)
    assert command.run(config) == 0
    assert is_finite(run)
    assert checkpoint.load(checkpoint.list_checkpoints(run)[-1]).metadata.iteration == tiny.LENGTH
    return capsys.readouterr().out, json.loads((run / "metrics.json").read_text())


def spoil_loss(monkeypatch, trainer, is_spoiled):
    """Makes the loss, and so all gradients, NaN in the iterations for which ``is_spoiled`` is true."""
    whole = losses.static_loss
    monkeypatch.setattr(
        losses, "static_loss", lambda *a: whole(*a) * (torch.nan if is_spoiled(trainer.iteration) else 1.0)
    )


@pytest.fixture
def spoiled_once(data, run, monkeypatch):
    """A trainer whose loss is NaN at its first visit of iteration 10; its last checkpoint is then of iteration 7."""
    trainer, iterations = tiny.trainer(data, run), [10]
    spoil_loss(monkeypatch, trainer, lambda k: k in iterations and not iterations.remove(k))
    return trainer


def test_after_a_loss_that_is_not_finite_training_rolls_back_and_ends_with_a_finite_scene(spoiled_once, run, capsys):
    assert tiny.train(spoiled_once)
    output = capsys.readouterr().out
    assert "the loss or a parameter is not finite after iteration 14: back to iteration 7" in output
    assert output.count("not finite") == 1
    assert checkpoint.load(checkpoint.list_checkpoints(run)[-1]).metadata.iteration == tiny.LENGTH
    assert is_finite(run)


def test_after_a_rollback_the_noise_differs(spoiled_once, data, run, tmp_path):
    """Otherwise the same loss would occur again."""
    reference = tiny.trainer(data, tmp_path / "reference")
    tiny.train(reference)
    tiny.train(spoiled_once)
    assert "scene.static.means" in tiny.differences(tiny.state(run), tiny.state(reference.run))


def test_a_run_with_a_rollback_resumes_bit_for_bit(spoiled_once, data, run, tmp_path):
    tiny.train(spoiled_once)
    again = tiny.trainer(data, tmp_path / "again")
    again.restore(checkpoint.path_of(run, 14))
    tiny.train(again)
    assert tiny.differences(tiny.state(again.run), tiny.state(run)) == []


@pytest.mark.parametrize("name", ["means", "log_scales", "sh_dc"])
def test_a_state_with_gaussians_that_are_not_finite_is_not_saved(data, run, name):
    """Nothing is pruned before the next checkpoint."""
    trainer = tiny.trainer(data, run)

    def spoil():
        if trainer.iteration == 1:
            getattr(trainer.scene.static, name).data[0] = torch.nan
        return trainer.iteration == 7

    tiny.train(trainer, tiny.StopWhen(spoil))
    assert is_finite(run)


@pytest.mark.parametrize(("first", "words"), [(8, "iteration 14, even after 3 returns"), (0, "iteration 7")])
def test_a_loss_that_stays_not_finite_is_an_error(data, run, monkeypatch, first, words):
    trainer = tiny.trainer(data, run)
    spoil_loss(monkeypatch, trainer, lambda k: k >= first)
    with pytest.raises(ValueError, match=f"is not finite after {words}") as caught:
        tiny.train(trainer)
    assert (str(checkpoint.path_of(run, 7)) in str(caught.value)) == (first == 8)
    assert is_finite(run)


def test_where_rates_are_far_above_their_defaults_that_error_names_them(data, run):
    trainer = tiny.trainer(data, run)
    optim = dataclasses.replace(trainer.config.optim, sh_dc=0.3, networks=0.02, means=0.001)
    trainer.rollbacks, trainer.config = MAX_ROLLBACKS, dataclasses.replace(trainer.config, optim=optim)
    message = r"; --optim\.sh-dc is 0\.3, by default 0\.01$"
    with TrainingLogger(None, tiny.LENGTH, 0) as log, pytest.raises(ValueError, match=message):
        trainer._roll_back(log)


@pytest.mark.parametrize(
    ("device", "half", "hints"), [("cuda", True, True), ("cuda", False, False), ("cpu", True, False)]
)
def test_where_networks_train_in_half_precision_that_error_names_the_option(data, run, device, half, hints):
    trainer = tiny.trainer(data, run)
    trainer.device, trainer.rollbacks = torch.device(device), MAX_ROLLBACKS
    trainer.config = dataclasses.replace(trainer.config, model=dataclasses.replace(trainer.config.model, half=half))
    with TrainingLogger(None, tiny.LENGTH, 0) as log, pytest.raises(ValueError, match="not finite") as caught:
        trainer._roll_back(log)
    assert ("--model.no-half" in str(caught.value)) == hints


def test_a_rollback_measures_the_speed_anew(spoiled_once, monkeypatch):
    begun, begin = [], TrainingLogger.begin
    monkeypatch.setattr(
        TrainingLogger, "begin", lambda log, iteration: begun.append(iteration) or begin(log, iteration)
    )
    tiny.train(spoiled_once)
    assert begun == [0, 7]


def run_as_main(monkeypatch, capsys, *arguments):
    """Exit code and error output of train.py."""
    monkeypatch.setattr("sys.argv", [SCRIPT, *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(SCRIPT, run_name="__main__")
    return caught.value.code, capsys.readouterr().err


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore of torch's advice."),
        MemoryError("no more"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate"),
    ],
)
def test_out_of_memory_is_one_line_with_advice(data, run, monkeypatch, capsys, error):
    monkeypatch.setattr(Step, "__call__", Mock(side_effect=error))
    options = ["--data", data, "--preset", "quick", "--device", "cpu", "--out", run]
    code, text = run_as_main(monkeypatch, capsys, *options)
    assert code == 2
    assert text.count("\n") == 1
    assert "out of memory" in text
    assert "--densify.max-gaussians" in text
    assert "--factor" in text


def test_out_of_memory_says_how_many_gaussians_were_too_many_and_leaves_the_last_checkpoint(
    data, run, monkeypatch, capsys
):
    take = Step.__call__

    def fail(step, plan, sample):
        if plan.done == 3:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        take(step, plan, sample)

    monkeypatch.setattr(Step, "__call__", fail)
    with pytest.raises(torch.OutOfMemoryError):
        command.run(dataclasses.replace(tiny.CONFIG, data=data, out=run))
    saved = checkpoint.load(checkpoint.list_checkpoints(run)[-1])
    assert saved.metadata.iteration == 7
    text = capsys.readouterr().out
    assert "memory ran out in iteration 9, with 50 static and 20 dynamic Gaussians; --densify.max-gaussians" in text


@pytest.mark.parametrize("error", [ValueError("a damaged file"), RuntimeError("a bug")])
def test_other_errors_say_nothing_of_memory(data, run, monkeypatch, capsys, error):
    monkeypatch.setattr(Step, "__call__", Mock(side_effect=error))
    with pytest.raises(type(error)):
        command.run(dataclasses.replace(tiny.CONFIG, data=data, out=run))
    assert "memory" not in capsys.readouterr().out


def test_a_capture_that_is_refused_leaves_no_run_folder(data, run, monkeypatch, capsys):
    shutil.rmtree(data / "resized_mask")
    options = ["--data", data, "--preset", "quick", "--device", "cpu", "--out", run]
    code, text = run_as_main(monkeypatch, capsys, *options)
    assert code == 2
    assert "--assume static" in text
    assert not run.exists()


def test_without_depth_stage_1_takes_the_iterations_of_the_pretraining(data, run):
    shutil.rmtree(data / "depth")
    trainer = tiny.trainer(data, run)
    assert trainer.protocol.pretrain.end == 0
    assert trainer.protocol.stage1.end == tiny.SCHEDULE.pretrain + tiny.SCHEDULE.stage1
    assert trainer.protocol.num_iterations == tiny.LENGTH


@pytest.mark.parametrize("missing", [["depth"], ["points.npy"], ["depth", "points.npy"]], ids=str)
def test_a_capture_without_depth_or_points_trains(data, run, monkeypatch, capsys, missing):
    for name in missing:
        (data / name).rename(data / f"no {name}")
    _, metrics = end_to_end(data, run, monkeypatch, capsys)
    assert metrics["num_static"] + metrics["num_dynamic"] > 0
    assert metrics["num_dynamic"] > 0 or "points.npy" in missing


def test_a_capture_without_evaluation_frames_trains_and_reports_what_is_not_measured(data, run, monkeypatch, capsys):
    edit_json(data / "dataset.json", val_ids=[])
    output, metrics = end_to_end(data, run, monkeypatch, capsys)
    assert "the capture has no evaluation frames: PSNR, SSIM and LPIPS not measured" in output
    assert metrics["psnr"] is None
    assert metrics["num_views"] == 0
    assert metrics["iterations"] == tiny.LENGTH


def test_a_capture_of_one_training_frame_trains(data, run, monkeypatch, capsys):
    edit_json(data / "dataset.json", train_ids=["left_000000"])
    _, metrics = end_to_end(data, run, monkeypatch, capsys)
    assert metrics["psnr"] > 0


def fill_masks(data, value):
    for path in (data / "resized_mask/1x").iterdir():
        write_png(path, np.full((tiny.SCENE.height, tiny.SCENE.width), value, np.uint8))


def test_a_capture_in_which_nothing_moves_trains(data, run, monkeypatch, capsys):
    fill_masks(data, 255)
    _, metrics = end_to_end(data, run, monkeypatch, capsys)
    assert metrics["psnr_dynamic"] is None
    assert metrics["psnr_static"] == metrics["psnr"]


def test_a_capture_in_which_everything_moves_trains_only_where_that_is_assumed(data, run, monkeypatch, capsys):
    fill_masks(data, 0)
    assert command.run(dataclasses.replace(tiny.CONFIG, data=data, out=run)) == 1
    assert "the masks mark everything as dynamic" in capsys.readouterr().err
    assert not run.exists()
    _, metrics = end_to_end(data, run, monkeypatch, capsys, assume="dynamic")
    assert metrics["num_static"] == 0 < metrics["num_dynamic"]


@pytest.mark.parametrize(("assume", "other"), [("static", "dynamic"), ("dynamic", "static")])
def test_assuming_one_branch_trains_no_gaussians_of_the_other(data, run, monkeypatch, capsys, assume, other):
    _, metrics = end_to_end(data, run, monkeypatch, capsys, assume=assume)
    assert metrics[f"num_{other}"] == 0
    assert metrics[f"num_{assume}"] > 0


@pytest.mark.parametrize("assume", ["static", "dynamic"])
def test_an_empty_branch_resumes(data, run, assume):
    config = dataclasses.replace(tiny.CONFIG, data=data, out=run, assume=assume)
    first = script.make_trainer(config)
    tiny.train(first, tiny.StopWhen(lambda: first.iteration >= 24))
    again = script.make_trainer(command.parse(["--resume", str(run)]))
    assert again.iteration == 24
    assert tiny.train(again)


def test_a_capture_without_masks_is_refused_with_advice(data, run):
    shutil.rmtree(data / "resized_mask")
    with pytest.raises(ValueError, match=r"has no mask of the dynamic region.*--add masks.*--assume static"):
        script.make_trainer(dataclasses.replace(tiny.CONFIG, data=data, out=run, dataset="nerfds"))


def test_a_capture_without_masks_trains_under_an_assumption(data, run, monkeypatch, capsys):
    shutil.rmtree(data / "resized_mask")
    _, metrics = end_to_end(data, run, monkeypatch, capsys, assume="static", dataset="nerfds")
    assert metrics["psnr"] > 0
    assert metrics["psnr_static"] is None
