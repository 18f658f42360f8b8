"""Estimated masks are tried out, and not used if held-out frames are better without them."""

import dataclasses
import json
import signal
import tempfile

import cv2
import numpy as np
import pytest

from tests import tiny, two_ranks
from warpgs.captures.opening import load_capture
from warpgs.config import TrainConfig
from warpgs.evaluation import evaluate_run
from warpgs.synthetic.room import builtin_capture
from warpgs.training import mask_trial
from warpgs.training.mask_trial import held_out_psnr, with_trusted_masks
from warpgs.training.train import train

LENGTH = 60
pytestmark = pytest.mark.usefixtures("quickly")

CONFIG = dataclasses.replace(tiny.CONFIG, preset="best", omit=("app",), assume="auto", background="black")


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """A trial that takes a second."""
    schedule = dataclasses.replace(tiny.SCHEDULE, stage1=LENGTH - 6, stage2=0)
    monkeypatch.setattr(mask_trial, "TRIAL", dataclasses.replace(tiny.CONFIG, schedule=schedule))
    monkeypatch.setattr(mask_trial, "MIN_RELATIVE_LENGTH", 0.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture of 17 frames whose masks are estimates that miss everything that moves."""
    scene = dataclasses.replace(tiny.SCENE, num_frames=17)
    root = builtin_capture(tmp_path_factory.mktemp("masks"), scene, quiet=True)
    index = root / "dataset.json"
    index.write_text(json.dumps(json.loads(index.read_text()) | {"masks": "estimated"}))
    for file in root.glob("resized_mask/*/*.png"):
        cv2.imwrite(str(file), np.full_like(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), 255))
    return root


@pytest.fixture
def qualities(monkeypatch):
    """PSNR with and without the masks, instead of trainings."""
    found = {"masks": 30.0, "dynamic": 30.0}
    monkeypatch.setattr(mask_trial, "held_out_psnr", lambda config, capture, assume, *_: found[assume])
    return found


def decide(folder, config=CONFIG):
    lines: list[str] = []
    return with_trusted_masks(config, load_capture(folder), lines.append, quiet=True)[0].assume, lines


def test_both_trainings_are_made_and_the_better_one_is_followed(folder, monkeypatch):
    measured = []

    def measure(config, capture, assume, *arguments):
        measured.append((assume, held_out_psnr(config, capture, assume, *arguments)))
        return measured[-1][1]

    monkeypatch.setattr(mask_trial, "held_out_psnr", measure)
    assume, lines = decide(folder)
    (_, following), (_, ignoring) = measured
    assert [name for name, _ in measured] == ["masks", "dynamic"]
    assert following != ignoring
    assert assume == ("dynamic" if ignoring > following else "masks")
    assert f"{following:.1f} dB with the masks and {ignoring:.1f} dB without" in lines[-1]


@pytest.mark.parametrize(("without", "assume"), [(29.0, "masks"), (30.0, "masks"), (30.1, "dynamic")])
def test_masks_are_used_unless_none_are_better(folder, qualities, without, assume):
    qualities["dynamic"] = without
    found, lines = decide(folder)
    assert found == assume
    assert f"30.0 dB with the masks and {without:.1f} dB without" in lines[-1]


@pytest.mark.parametrize("changes", [{"assume": "static"}, {"assume": "masks"}])
def test_masks_that_are_not_in_question_are_not_tried(folder, qualities, changes):
    qualities["dynamic"] = 40.0
    config = dataclasses.replace(CONFIG, **changes)
    assert decide(folder, config) == (config.assume, [])


def test_given_masks_and_few_frames_are_not_tried(folder, qualities):
    qualities["dynamic"] = 40.0
    capture = load_capture(folder)
    few, given = capture.split(capture.train[:15], ()), load_capture(folder)
    given.estimated_masks = False
    for other in (few, given):
        following = dataclasses.replace(CONFIG, assume="masks")
        assert with_trusted_masks(CONFIG, other, print, quiet=True) == (following, {})


def test_runs_that_are_hardly_longer_are_not_tried(folder, qualities, monkeypatch):
    qualities["dynamic"] = 40.0
    monkeypatch.setattr(mask_trial, "MIN_RELATIVE_LENGTH", tiny.LENGTH / LENGTH + 0.01)
    assert decide(folder) == ("masks", [])


def test_a_trial_that_fails_leaves_the_masks_in_use(folder, monkeypatch):
    def fail(*_):
        raise ValueError("the loss is not finite")

    monkeypatch.setattr(mask_trial, "held_out_psnr", fail)
    assume, lines = decide(folder)
    assert assume == "masks"
    assert lines[-1] == "the masks are used, because they could not be tried out: the loss is not finite"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_trial_and_leaves_nothing_behind(folder, monkeypatch, tmp_path, number):
    class Interrupted(mask_trial.Trainer):
        def train(self, logger, interrupt):
            signal.raise_signal(number)
            return super().train(logger, interrupt)

    monkeypatch.setattr(mask_trial, "Trainer", Interrupted)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(KeyboardInterrupt, match="no run has begun: give the same command again"):
        decide(folder)
    assert list(tmp_path.iterdir()) == []


def test_the_trial_sees_small_images(folder, monkeypatch):
    sizes = set()

    def psnr(config, capture, *_):
        sizes.add(capture.frame(capture.train[0]).image.shape)
        return 30.0

    monkeypatch.setattr(mask_trial, "held_out_psnr", psnr)
    monkeypatch.setattr(mask_trial, "MAX_SIDE", 16)
    decide(folder)
    assert sizes == {(12, 16, 3)}


def test_held_out_frames_are_not_trained_on(folder, monkeypatch):
    trained = []

    class Watched(mask_trial.Trainer):
        def __init__(self, start, run):
            super().__init__(start, run)
            trained.append((start.plan, start.capture.train, start.capture.val, run))

    monkeypatch.setattr(mask_trial, "Trainer", Watched)
    capture = load_capture(folder)
    assert np.isfinite(held_out_psnr(dataclasses.replace(CONFIG, iterations=5_000, exposure=True), capture, "dynamic"))
    [(config, train, val, run)] = trained
    assert val == (capture.train[4], capture.train[12])
    assert sorted((*train, *val)) == sorted(capture.train)
    assert (config.schedule.num_iterations, config.iterations, config.assume) == (LENGTH, None, "dynamic")
    assert config.omit == ("app",)  # a switch of the run
    assert not config.exposure  # held-out frames are compared as they are
    assert not run.exists()


def test_metrics_have_the_results_of_the_trial_also_after_the_run_was_resumed(folder, qualities, monkeypatch, tmp_path):
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    out, expected = tmp_path / "run", {"mask_trial_psnr_with": 30.0, "mask_trial_psnr_without": 30.2}
    qualities["dynamic"] = 30.2
    for config in (dataclasses.replace(CONFIG, data=folder, out=out), TrainConfig(resume=out)):
        train(config)
        metrics = json.loads((out / "metrics.json").read_text())
        assert metrics.pop("mask_trial_seconds") > 0
        assert {name: value for name, value in metrics.items() if name.startswith("mask_trial")} == expected
        (out / "metrics.json").unlink()


def test_metrics_without_a_trial_do_not_mention_it(folder, qualities, monkeypatch, tmp_path):
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    train(dataclasses.replace(CONFIG, data=folder, out=tmp_path / "run", assume="masks"))
    assert "mask_trial" not in (tmp_path / "run" / "metrics.json").read_text()
    assert not (tmp_path / "run" / "mask_trial.json").exists()


def test_all_ranks_follow_the_decision_of_the_first(folder, tmp_path):
    config = dataclasses.replace(CONFIG, data=folder, out=tmp_path / "ranks" / "run")
    assert two_ranks.start(tmp_path / "ranks", two_ranks.try_masks, config) == [0, 0]
    found = [json.loads((tmp_path / "ranks" / f"rank{k}.json").read_text()) for k in (0, 1)]
    assert found == [{"assume": "dynamic"}, {"assume": "dynamic"}]
