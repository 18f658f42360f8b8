"""Callbacks of ``train``, held-out views in TensorBoard, previews for the viewer, and longer runs."""

import dataclasses
import json
import time

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import warpgs
from tests import plain, tiny
from warpgs.config import TrainConfig, extended
from warpgs.evaluation.held_out import HELD_OUT_VIEWS
from warpgs.runs import preview
from warpgs.runs.config_file import read_config
from warpgs.training import command, trainer
from warpgs.training import train as script
from warpgs.training.schedule import Protocol

pytestmark = pytest.mark.usefixtures("quickly")


CHECK_EVERY = 4
CALLED_AT = sorted({*range(4, 33, CHECK_EVERY), *range(7, 33, 7)})
"""Iterations of regular checks and of checkpoints."""


class Watched:
    """A run with a callback that renders, takes long, and asks for a preview after iteration 12."""

    def __init__(self, config: TrainConfig, clock: list[float]) -> None:
        self.folder, self.clock = config.out, clock
        self.means, self.states = {}, []
        self.run = warpgs.train(config, callbacks=[self.watch])

    def watch(self, progress: warpgs.Progress) -> None:
        camera = progress.capture.cameras[progress.capture.train[0]]
        iteration = progress.status.iteration
        self.means[iteration] = progress.scene.render(camera, 0.5).joint.image.mean().item()
        self.states.append(preview.read_state(self.folder))
        self.clock[0] += 1000.0
        if iteration == 12:
            preview.request(self.folder)


@pytest.fixture(scope="module")
def watched(data, tmp_path_factory):
    config = dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path_factory.mktemp("watched") / "run")
    clock, monotonic = [0.0], time.monotonic
    with pytest.MonkeyPatch.context() as patch, tiny.in_haste():
        patch.setattr(trainer, "CHECK_EVERY", CHECK_EVERY)
        patch.setattr(time, "monotonic", lambda: monotonic() + clock[0])
        return Watched(config, clock)


@pytest.fixture
def config(data, tmp_path, monkeypatch):
    """The config of a run that is not evaluated at its end."""
    monkeypatch.setattr(trainer, "CHECK_EVERY", CHECK_EVERY)
    monkeypatch.setattr(script, "evaluate_run", lambda *_, **__: "")
    return dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path / "run")


def test_callbacks_see_every_check_and_can_render_the_scene(watched):
    assert list(watched.means) == CALLED_AT
    assert len(set(watched.means.values())) == len(CALLED_AT)  # the scene is the one of that iteration
    capture = watched.run.open_capture()
    last = watched.run.trained_scene().render(capture.cameras[capture.train[0]], 0.5).joint.image.mean().item()
    assert watched.means[tiny.LENGTH] == last


def test_callbacks_change_nothing_and_take_no_training_time(watched, data, tmp_path):
    tiny.train(tiny.trainer(data, tmp_path, watched.run.config))
    assert tiny.differences(tiny.state(watched.folder), tiny.state(tmp_path)) == []
    assert watched.run.trained_scene().metadata.train_seconds < 500.0


def test_tensorboard_has_psnr_and_images_of_held_out_views(watched):
    events = EventAccumulator(str(watched.folder / "events"), size_guidance={"images": 0})
    events.Reload()
    val = watched.run.open_capture().val
    steps = [event.step for event in events.Scalars("psnr/held-out")]
    assert steps[-1] == tiny.LENGTH
    assert {f"held-out/{name}" for name in val} <= set(events.Tags()["images"])
    assert len(events.Images(f"held-out/{val[0]}")) == len(steps)
    assert len(events.Images(f"held-out/{val[0]}, truth")) == 1
    metrics = json.loads((watched.folder / "metrics.json").read_text())
    assert len(val) == HELD_OUT_VIEWS
    assert events.Scalars("psnr/held-out")[-1].value == pytest.approx(metrics["psnr"], abs=1e-3)


def test_the_scene_is_written_for_a_viewer_only_while_one_asks(watched):
    assert not any(watched.states[: CALLED_AT.index(12) + 1])
    state = watched.states[CALLED_AT.index(12) + 1]
    assert (state.iteration, state.num_iterations) == (12, tiny.LENGTH)
    assert not (watched.folder / preview.SCENE).exists()  # removed at the end: the last checkpoint is newer


def test_a_training_that_fails_leaves_no_preview(config):
    def fail(progress):
        if preview.read_state(config.out) is not None:
            raise RuntimeError("no")
        preview.request(config.out)

    with pytest.raises(RuntimeError, match="no"):
        warpgs.train(config, callbacks=[fail])
    assert not any((config.out / name).exists() for name in (preview.REQUEST, preview.SCENE, preview.STATE))


def test_a_callback_that_returns_true_ends_training_with_a_checkpoint(config):
    run = warpgs.train(config, callbacks=[lambda progress: progress.status.iteration >= 12])
    assert run.trained_scene().metadata.iteration == 12


# Longer runs ----------------------------------------------------------------------------------------------------------


def test_a_run_is_extended(config):
    warpgs.train(config, callbacks=[lambda progress: True])
    longer = command.parse(["--resume", str(config.out), "--iterations", "40"])
    run = warpgs.train(longer)
    assert run.trained_scene().metadata.iteration == 40
    assert read_config(config.out).schedule == dataclasses.replace(tiny.SCHEDULE, stage2=18)
    assert warpgs.train(TrainConfig(resume=config.out)).trained_scene().metadata.iteration == 40  # nothing left to do


def test_the_last_stage_takes_the_added_iterations():
    longer = Protocol(extended(plain.plan(tiny.CONFIG), 50), has_depth=True)
    assert (longer.stage1.end, longer.stage2.end) == (22, 50)
    only = dataclasses.replace(tiny.CONFIG, schedule=dataclasses.replace(tiny.SCHEDULE, stage2=0))
    assert Protocol(extended(plain.plan(only), 50), has_depth=True).stage1.end == 50


def test_the_gaussians_of_a_longer_run_settle_at_its_end():
    settling = dataclasses.replace(tiny.CONFIG, schedule=dataclasses.replace(tiny.SCHEDULE, settle=8))
    longer = Protocol(extended(plain.plan(settling), 50), has_depth=True)
    assert [longer.at(k).phase.use_dropout for k in (30, 41, 42)] == [True, True, False]
    assert [longer.at(k).settle_progress for k in (30, 42, 46)] == [0.0, 0.0, 0.5]


def test_a_run_is_not_shortened():
    with pytest.raises(ValueError, match="expected at least its 32, got 31"):
        extended(plain.plan(tiny.CONFIG), 31)
