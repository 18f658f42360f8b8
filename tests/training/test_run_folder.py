"""The folder of a run belongs to one training at a time, and is neither made again nor left behind."""

import dataclasses
import re
import shutil

import pytest

from tests import tiny
from warpgs.config import TrainConfig
from warpgs.errors import run_command
from warpgs.evaluation import evaluate_run
from warpgs.runs.config_file import read_config
from warpgs.runs.run import Run
from warpgs.training import command
from warpgs.training import train as script
from warpgs.training.train import train

pytestmark = pytest.mark.usefixtures("contracts_off")


def test_a_training_that_is_refused_leaves_the_run_of_another_as_it_is(config, monkeypatch):
    """The other one tries its masks out, so that it has written nothing yet, and evaluates in the end."""
    refusals = []

    def refuse_another(*_, **__):
        another = dataclasses.replace(config, seed=7, iterations=60, resume=config.out if refusals else None)
        with pytest.raises(ValueError, match=f"^{config.out} is being trained by another process") as raised:
            train(another)
        refusals.append(str(raised.value))

    try_masks, evaluate = script.with_trusted_masks, script.evaluate_run
    monkeypatch.setattr(script, "with_trusted_masks", lambda *args: refuse_another() or try_masks(*args))
    monkeypatch.setattr(script, "evaluate_run", lambda *args: refuse_another() or evaluate(*args))
    run = train(config)
    assert len(refusals) == 2
    assert read_config(config.out) == dataclasses.replace(run.config, out=config.out)
    assert read_config(config.out).seed == config.seed


def test_a_refused_resume_leaves_damaged_checkpoints_to_the_one_that_trains(finished_run, tmp_path):
    run = shutil.copytree(finished_run, tmp_path / "run")
    newest = Run.open(run).newest_checkpoint()
    newest.write_bytes(b"damaged")
    with Run.open(run).lock(), pytest.raises(ValueError, match="is being trained by another process"):
        script.make_trainer(TrainConfig(resume=run, device="cpu"))
    assert newest.read_bytes() == b"damaged"


def test_a_refused_run_leaves_no_folder_and_one_that_was_killed_before_its_first_write_an_empty_one(config, tmp_path):
    with pytest.raises(ValueError, match="dataset"):
        train(dataclasses.replace(config, dataset="nonsense"))
    assert not config.out.exists()
    config.out.mkdir()
    (config.out / ".lock").touch()
    assert train(config).folder == config.out
    assert not (config.out / ".lock").exists()


@pytest.mark.parametrize("is_deleted", [False, True])
@pytest.mark.parametrize("when", ["train", "evaluate"])
def test_a_run_folder_that_is_moved_or_deleted_ends_in_one_line_and_is_not_made_again(
    config, tmp_path, monkeypatch, capfd, when, is_deleted
):
    def lose(*_):
        if config.out.exists():
            config.out.rename(tmp_path / "moved")
            if is_deleted:
                shutil.rmtree(tmp_path / "moved")

    if when == "train":
        monkeypatch.setattr(script, "Previewer", lambda *_: lose)
    if when == "evaluate":
        evaluate = evaluate_run.evaluate
        monkeypatch.setattr(evaluate_run, "evaluate", lambda *args: lose() or evaluate(*args))
    assert run_command(lambda: command.run(config), "train.py") == 2
    error = capfd.readouterr().err
    assert re.fullmatch(f"train.py: {config.out} was moved or deleted meanwhile: .*--resume.*\n", error)
    assert not config.out.exists()
    if not is_deleted:
        again = train(TrainConfig(resume=tmp_path / "moved"))
        assert again.trained_scene().metadata.iteration == tiny.LENGTH
