"""What is not a run, or a damaged one, ends every command that reads runs with one line."""

import shutil

import pytest

from tests import tiny
from tests.data.captures import edit_json
from warpgs.cli import main
from warpgs.runs import checkpoint
from warpgs.runs.run import Run

COMMANDS = {
    "render": ["render"],
    "export": ["export"],
    "view": ["view", "--port", "0"],
    "bench": ["bench", "--device", "cpu", "--fps"],
    "report": ["report"],
}


def empty(run):
    shutil.rmtree(run)
    run.mkdir()
    return f"{run} is not a run folder: it has no config.json\n"


def change_version(run):
    edit_json(run / "config.json", future=1)
    return f"{run / 'config.json'} has fields of another version: future\n"


def nest_config(run):
    (run / "config.json").write_text("{" + "[" * 100_000)
    return f"{run / 'config.json'} "


def remove_checkpoints(run):
    shutil.rmtree(run / "checkpoints")
    return f"{run} has no checkpoint yet: warpgs train --resume {run} trains on\n"


def truncate_checkpoint(run):
    path = checkpoint.list_checkpoints(run)[-1]
    path.write_bytes(path.read_bytes()[:1000])
    return f"{path} is damaged"


def remove_metadata(run):
    path = checkpoint.list_checkpoints(run)[-1]
    tiny.edit_metadata(path, lambda values: values.pop("relit"))
    return f"{path} is damaged: it has no relit"


OF_CONFIG = [empty, change_version, nest_config]
OF_CHECKPOINT = [remove_checkpoints, truncate_checkpoint, remove_metadata]
"""A report does without."""

CASES = [(command, damage) for command in COMMANDS for damage in (*OF_CONFIG, *(OF_CHECKPOINT * (command != "report")))]


@pytest.mark.parametrize(("command", "damage"), CASES)
def test_a_bad_run_ends_a_command_with_one_line(finished_run, tmp_path, capsys, command, damage):
    if command == "view":
        pytest.importorskip("viser", reason="the viewer needs viser: pip install 'warpgs[viewer]'")
    run = shutil.copytree(finished_run, tmp_path / "run")
    beginning = f"warpgs {command}: {damage(run)}"
    assert main([*COMMANDS[command], str(run)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(beginning)
    assert error.count("\n") == 1


@pytest.mark.parametrize("others", [0, 1])
def test_a_damaged_checkpoint_is_named_and_training_continues_from_another(finished_run, tmp_path, others):
    run = shutil.copytree(finished_run, tmp_path / "run")
    *earlier, newest = checkpoint.list_checkpoints(run)
    for path in earlier:
        path.unlink()
    if others:
        shutil.copy(newest, checkpoint.path_of(run, 1))
    newest.write_bytes(newest.read_bytes()[:1000])
    with pytest.raises(ValueError, match=f"{newest} is damaged") as raised:
        Run.open(run, "cpu").trained_scene()
    assert str(raised.value).endswith(f"{run} continues from the newest intact one") == bool(others)


@pytest.mark.parametrize("command", ["render", "eval"])
def test_a_command_says_how_to_use_the_checkpoint_before_a_damaged_one(finished_run, tmp_path, capsys, command):
    run = shutil.copytree(finished_run, tmp_path / "run")
    *_, before, newest = checkpoint.list_checkpoints(run)
    newest.write_bytes(newest.read_bytes()[:1000])
    assert main([command, str(run), "--device", "cpu", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert f"; move it elsewhere to use {before.name}, or " in error
    assert error.count("\n") == 1
    newest.rename(tmp_path / newest.name)
    assert Run.open(run, "cpu").newest_checkpoint() == before
    Run.open(run, "cpu").trained_scene()
