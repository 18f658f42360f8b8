"""A resumed run continues bit for bit as if it had never stopped."""

import dataclasses
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests import tiny
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS
from warpgs.evaluation import evaluate_run
from warpgs.initialization import motion_fit
from warpgs.runs import checkpoint
from warpgs.training import command
from warpgs.training import train as script

pytestmark = pytest.mark.usefixtures("quickly")

SCRIPT = str(Path(__file__).parents[2] / "train.py")

# Long enough to be killed before the end.
LONG = {
    "preset": "quick",
    "device": "cpu",
    "iterations": 120,
    "checkpoint-every": 15,
    "model.width": 8,
    "model.depth": 2,
    "model.skip": 1,
    "model.max-static-points": 100,
    "model.dynamic-points": 50,
    "densify.max-gaussians": 200,
    "densify.every": 20,
    "densify.gradient": 1e-5,
}


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A run without interruption."""
    run = tmp_path_factory.mktemp("whole")
    trainer = tiny.trainer(data, run)
    assert tiny.train(trainer)
    return run


def resumed(data, run):
    trainer = tiny.trainer(data, run)
    trainer.restore_newest(print)
    assert tiny.train(trainer)
    return trainer


def test_the_tiny_run_densifies_and_prunes(whole):
    counts = [len(checkpoint.load(path).tensors["scene.static.means"]) for path in checkpoint.list_checkpoints(whole)]
    assert max(counts) > counts[0]
    assert 10 < counts[-1] < max(counts)


def test_two_runs_are_bit_identical(data, whole, tmp_path):
    tiny.train(tiny.trainer(data, tmp_path))
    assert tiny.differences(tiny.state(tmp_path), tiny.state(whole)) == []


# In pretraining, before and after the first densification, at the start of stage II.
@pytest.mark.parametrize("stop", [3, 9, 14, 22])
def test_a_resumed_run_is_bit_identical(data, whole, tmp_path, stop):
    first = tiny.trainer(data, tmp_path)
    assert not tiny.train(first, tiny.StopWhen(lambda: first.iteration >= stop))
    assert first.iteration == stop
    resumed(data, tmp_path)
    assert tiny.differences(tiny.state(tmp_path), tiny.state(whole)) == []


def test_a_run_stopped_while_the_deformation_is_fitted_to_points_is_bit_identical(data, whole, tmp_path, monkeypatch):
    fitting = []
    take_step = motion_fit._take_step
    monkeypatch.setattr(motion_fit, "_take_step", lambda *args: fitting.append(0) or take_step(*args))
    first = tiny.trainer(data, tmp_path)
    assert not tiny.train(first, tiny.StopWhen(lambda: len(fitting) == 2))
    assert (first.iteration, len(fitting)) == (first.protocol.stage1.start, 2)
    resumed(data, tmp_path)
    assert tiny.differences(tiny.state(tmp_path), tiny.state(whole)) == []


def test_a_run_resumed_after_every_iteration_is_bit_identical(data, whole, tmp_path):
    for last in range(1, tiny.LENGTH + 1):
        trainer = tiny.trainer(data, tmp_path)
        trainer.restore_newest(print)
        tiny.train(trainer, tiny.StopWhen(lambda trainer=trainer, last=last: trainer.iteration >= last))
        assert trainer.iteration == last
    assert tiny.differences(tiny.state(tmp_path), tiny.state(whole)) == []


def test_a_run_resumed_from_an_earlier_checkpoint_is_bit_identical(data, whole, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    trainer.restore(checkpoint.path_of(whole, 7))
    tiny.train(trainer)
    assert tiny.differences(tiny.state(tmp_path), tiny.state(whole)) == []


@pytest.mark.parametrize("poses", [0.0, 1e-3])
def test_a_run_of_version_0_3_keeps_the_extent_as_its_unit(data, tmp_path, poses):
    config = dataclasses.replace(tiny.CONFIG, optim=dataclasses.replace(tiny.CONFIG.optim, poses=poses))
    first = tiny.trainer(data, tmp_path, config)
    first.save()
    tiny.edit_metadata(checkpoint.path_of(tmp_path, 0), lambda fields: fields.pop("unit"))
    again = tiny.trainer(data, tmp_path, config)
    again.restore_newest(print)
    assert first.unit == first.capture.view_size
    assert again.unit == again.step.unit == first.capture.extent != first.unit
    assert again.views.poses is None or again.views.poses.unit == again.unit
    again.save()
    assert checkpoint.load(checkpoint.path_of(tmp_path, 0)).metadata.unit == again.unit


def test_training_keeps_the_two_newest_checkpoints(data, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "NUM_KEPT", 2)
    tiny.train(tiny.trainer(data, tmp_path))
    assert checkpoint.list_checkpoints(tmp_path) == [checkpoint.path_of(tmp_path, at) for at in (28, tiny.LENGTH)]


def test_another_seed_gives_another_run(data, whole, tmp_path):
    """So the comparisons above are meaningful."""
    config = dataclasses.replace(tiny.CONFIG, seed=1)
    tiny.train(tiny.trainer(data, tmp_path, config))
    assert "scene.static.means" in tiny.differences(tiny.state(tmp_path), tiny.state(whole))


def test_resuming_a_finished_run_changes_nothing(data, whole):
    before = {path: path.read_bytes() for path in checkpoint.list_checkpoints(whole)}
    trainer = resumed(data, whole)
    assert trainer.iteration == tiny.LENGTH
    assert {path: path.read_bytes() for path in checkpoint.list_checkpoints(whole)} == before


def test_training_time_adds_up_over_sessions(data, tmp_path):
    first = tiny.trainer(data, tmp_path)
    first.seconds = 1000.0
    tiny.train(first, tiny.StopWhen(lambda: first.iteration >= 5))
    resumed(data, tmp_path)
    seconds = checkpoint.load(checkpoint.list_checkpoints(tmp_path)[-1]).metadata.train_seconds
    assert 1000.0 < seconds < 1100.0


@pytest.fixture
def stopped(data, tmp_path):
    """A run that was interrupted, with checkpoints of iterations 0, 7 and 10."""
    config = dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path / "run")
    trainer = script.make_trainer(config)
    tiny.train(trainer, tiny.StopWhen(lambda: trainer.iteration >= 10))
    return trainer.run


def test_a_run_with_the_options_for_captures_resumes_bit_by_bit(data, tmp_path):
    """Margins, trust in depth and exposure are computed anew from the capture."""
    model, loss = dataclasses.replace(tiny.MODEL, appearance_size=(1, 4)), PRESETS["best"].loss
    densify = dataclasses.replace(tiny.CONFIG.densify, min_pixels=40)
    options = {"antialias": True, "exposure": True, "frozen": "nothing"}
    options["optim"] = dataclasses.replace(tiny.CONFIG.optim, poses=1e-3)
    options["schedule"] = dataclasses.replace(tiny.SCHEDULE, joint_from=0)
    config = dataclasses.replace(tiny.CONFIG, model=model, loss=loss, densify=densify, **options)
    whole = tiny.trainer(data, tmp_path / "whole", config)
    tiny.train(whole)
    first = tiny.trainer(data, tmp_path / "parts", config)
    tiny.train(first, tiny.StopWhen(lambda: first.iteration >= 12))
    second = tiny.trainer(data, tmp_path / "parts", config)
    second.restore_newest(print)
    assert second.iteration == 12
    tiny.train(second)
    assert tiny.differences(tiny.state(tmp_path / "whole"), tiny.state(tmp_path / "parts")) == []
    assert (second.views.poses.angles() > 0.0).all()


def test_a_run_of_few_frames_has_few_frequencies_of_time_and_can_be_resumed(data, tmp_path):
    model = dataclasses.replace(tiny.MODEL, time_bands=8, min_period=4.0)
    config = dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path / "run", model=model)
    trainer = script.make_trainer(config)
    assert "the networks get 2 of 8 frequencies of time: 6 times determine no more" in trainer.notes
    assert trainer.config.model.time_bands == trainer.scene.deformation.trunk.bands[1] == 2
    trainer.save()
    assert script.make_trainer(TrainConfig(resume=trainer.run)).config == trainer.config


def test_a_resumed_run_keeps_its_device_unless_another_is_given(stopped, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)  # the default of a new run would be CUDA
    assert script.make_trainer(TrainConfig(resume=stopped)).config.device == "cpu"


def truncate(path):
    path.write_bytes(path.read_bytes()[:-1])


def flip_a_bit(path):
    data = bytearray(path.read_bytes())
    data[-5] ^= 4
    path.write_bytes(data)


def spoil(name, value):
    """Changes one value of a tensor and writes the checkpoint as training would."""

    def change(path):
        loaded = checkpoint.load(path)
        loaded.tensors[name].view(-1)[0] = value
        checkpoint.save(path, loaded.tensors, loaded.metadata)

    return change


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "truncated": truncate,
    "bit": flip_a_bit,
    "moment": spoil("adam.exp_avg.static.means", torch.nan),
    "squared": spoil("adam.exp_avg_sq.static.means", -1.0),
    "step": spoil("adam.step.static.means", -1.0),
    "gradients": spoil("gradients.total", torch.inf),
    "scene": spoil("scene.static.means", torch.nan),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_with_a_damaged_newest_checkpoint_a_run_continues_from_the_one_before_and_names_both(stopped, whole, damage):
    before, newest = checkpoint.list_checkpoints(stopped)[-2:]
    damage(newest)
    lines = []
    trainer = script.make_trainer(command.parse(["--resume", str(stopped)]), lines.append)
    assert trainer.iteration == 7
    (line,) = [line for line in lines if "damaged" in line]
    assert line.startswith(f"warning: {newest} is damaged: ")
    assert line.endswith(f"; it is now {newest.name}.damaged, and training continues from {before}")
    assert newest not in checkpoint.list_checkpoints(stopped)
    assert tiny.train(trainer)
    assert tiny.differences(tiny.state(stopped), tiny.state(whole)) == []


def test_two_damaged_checkpoints_are_both_passed_over(stopped):
    for path in checkpoint.list_checkpoints(stopped)[1:]:
        truncate(path)
    lines = []
    assert script.make_trainer(TrainConfig(resume=stopped), lines.append).iteration == 0
    assert sum("is damaged" in line for line in lines) == 2


def test_without_an_undamaged_checkpoint_the_newest_is_refused_and_all_are_kept(stopped):
    paths = checkpoint.list_checkpoints(stopped)
    for path in paths:
        truncate(path)
    with pytest.raises(ValueError, match=f"^{paths[-1]} is damaged"):
        script.make_trainer(TrainConfig(resume=stopped))
    assert checkpoint.list_checkpoints(stopped) == paths


def test_a_killed_and_resumed_run_is_bit_identical(data, tmp_path, monkeypatch):
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    words = [word for key, value in {"data": data, **LONG}.items() for word in (f"--{key}", str(value))]
    options = [*words, "--out"]
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    with subprocess.Popen([sys.executable, SCRIPT, *options, str(killed)], stdout=subprocess.DEVNULL) as run:
        try:
            while not checkpoint.path_of(killed, 30).exists():
                assert run.poll() is None
                time.sleep(0.005)
        finally:
            run.kill()
    assert run.returncode == -signal.SIGKILL
    last = checkpoint.load(checkpoint.list_checkpoints(killed)[-1]).metadata.iteration
    assert 30 <= last < 120

    reference = script.make_trainer(command.parse([*options, str(whole)]))
    tiny.train(reference)
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    assert command.main(["--resume", str(killed)]) == 0
    assert tiny.differences(tiny.state(killed), tiny.state(whole)) == []
    assert (killed / "metrics.json").is_file()


@pytest.fixture
def finished(whole, tmp_path):
    """A copy of the run without interruption."""
    return shutil.copytree(whole, tmp_path / "run")


@pytest.mark.parametrize(
    "name", ["adam.exp_avg.static.means", "adam.exp_avg_sq.dynamic.sh_dc", "gradients.total", "alignments"]
)
def test_state_of_another_size_is_refused_by_name(data, finished, name):
    path = checkpoint.list_checkpoints(finished)[-1]
    loaded = checkpoint.load(path)
    checkpoint.save(path, {**loaded.tensors, name: loaded.tensors[name][:2].clone()}, loaded.metadata)
    with pytest.raises(ValueError, match=rf"{path.name} is damaged: expected {name} as "):
        tiny.trainer(data, finished).restore(path)


def test_a_capture_whose_frames_have_changed_is_refused(data, finished):
    tiny.edit_metadata(checkpoint.list_checkpoints(finished)[-1], lambda values: values["views"].reverse())
    with pytest.raises(ValueError, match="was trained on other frames than builtin has now"):
        tiny.trainer(data, finished).restore_newest(print)


def test_a_capture_whose_times_have_changed_is_refused(data, finished):
    path = checkpoint.list_checkpoints(finished)[-1]
    times = checkpoint.load(path).metadata.times
    assert len(times) > 1
    assert max(times) <= 1
    tiny.edit_metadata(path, lambda values: values.update(times=[time / 2 for time in times]))
    message = rf"frame \S+ of builtin had time {times[1] / 2:.4g} in training and has {times[1]:.4g} now: .*"
    with pytest.raises(ValueError, match=message):
        tiny.trainer(data, finished).restore_newest(print)


def test_a_run_without_a_checkpoint_starts_from_the_beginning(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path / "run")
    trainer.restore_newest(print)
    assert trainer.iteration == 0
