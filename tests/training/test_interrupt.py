"""Ctrl-C and SIGTERM: the first is recorded, the second interrupts, and the previous handler is restored."""

import dataclasses
import signal
import threading

import pytest

from tests import tiny
from warpgs.command_line.interrupt import Interrupt
from warpgs.runs import checkpoint
from warpgs.training import command, trainer
from warpgs.training import train as script
from warpgs.training.step import Step
from warpgs.training.train import TrainingInterrupted


@pytest.fixture(autouse=True)
def _as_in_a_terminal():
    """Restores the default handler: background jobs ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press():
    signal.raise_signal(signal.SIGINT)


def test_the_first_ctrl_c_is_only_recorded_and_all_later_ones_interrupt():
    with Interrupt() as interrupt:
        assert not interrupt.requested
        press()
        assert interrupt.requested
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                press()
    with Interrupt() as another:
        assert not another.requested


def test_sigterm_is_only_recorded_as_often_as_it_comes():
    before = signal.getsignal(signal.SIGTERM)
    with Interrupt() as interrupt:
        for _ in range(2):
            signal.raise_signal(signal.SIGTERM)
            assert interrupt.requested
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("presses", [0, 1])
def test_the_previous_handler_is_restored(presses):
    pressed = []
    signal.signal(signal.SIGINT, lambda *_: pressed.append("before"))
    with Interrupt():
        for _ in range(presses):
            press()
    assert pressed == []
    press()
    assert pressed == ["before"]


def test_the_previous_handler_is_restored_after_an_error():
    with pytest.raises(ValueError, match="wrong"), Interrupt():
        raise ValueError("wrong")
    with pytest.raises(KeyboardInterrupt):
        press()


@pytest.fixture
def config(data, tmp_path, contracts_off):
    return dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path / "run")


def pressing_in_step(monkeypatch, number, presses):
    """Presses Ctrl-C in the ``number``-th step, right after its update."""
    whole, steps = Step.__call__, []

    def step(self, *arguments):
        whole(self, *arguments)
        steps.append(arguments)
        if len(steps) == number:
            for _ in range(presses):
                press()

    monkeypatch.setattr(Step, "__call__", step)


def test_after_ctrl_c_the_current_iteration_finishes_and_is_saved(config, monkeypatch):
    pressing_in_step(monkeypatch, number=5, presses=1)
    with pytest.raises(TrainingInterrupted) as stop:
        script.train(config)
    assert checkpoint.load(checkpoint.list_checkpoints(config.out)[-1]).metadata.iteration == 5
    assert (stop.value.folder, stop.value.iteration, stop.value.num_iterations) == (config.out, 5, tiny.LENGTH)


def test_the_command_reports_an_interrupted_training_with_exit_code_130(config, monkeypatch, capsys):
    pressing_in_step(monkeypatch, number=5, presses=1)
    monkeypatch.setattr(command, "parse", lambda *_: config)
    assert command.main([]) == 130
    stderr = capsys.readouterr().err
    assert f"stopped after iteration 5 of {tiny.LENGTH}; continue with warpgs train --resume {config.out}" in stderr


def test_a_resumed_training_says_after_which_iteration_it_begins(config, monkeypatch):
    lines = []
    pressing_in_step(monkeypatch, number=5, presses=1)
    with pytest.raises(TrainingInterrupted):
        script.train(config, log=lines.append)
    assert not any("after iteration" in line for line in lines)
    pressing_in_step(monkeypatch, number=1, presses=1)
    with pytest.raises(TrainingInterrupted):
        script.train(command.parse(["--resume", str(config.out)]), log=lines.append)
    assert any(line.endswith(f"after iteration 5 of {tiny.LENGTH}") for line in lines)


def test_a_second_ctrl_c_stops_at_once_and_leaves_whole_checkpoints(config, monkeypatch):
    pressing_in_step(monkeypatch, number=10, presses=2)
    with pytest.raises(KeyboardInterrupt):
        script.train(config)
    assert [checkpoint.load(path).metadata.iteration for path in checkpoint.list_checkpoints(config.out)] == [0, 7]
    assert script.make_trainer(command.parse(["--resume", str(config.out)])).iteration == 7


def test_a_second_ctrl_c_while_the_checkpoint_is_written_leaves_whole_checkpoints(config, monkeypatch):
    pressing_in_step(monkeypatch, number=10, presses=1)
    fsync = checkpoint.os.fsync

    def fsync_and_press(file):
        fsync(file)
        if len(checkpoint.list_checkpoints(config.out)) == 2:
            press()

    monkeypatch.setattr(checkpoint.os, "fsync", fsync_and_press)
    with pytest.raises(KeyboardInterrupt):
        script.train(config)
    assert [checkpoint.load(path).metadata.iteration for path in checkpoint.list_checkpoints(config.out)] == [0, 7]
    assert list((config.out / "checkpoints").glob("*.partial")) == []


def test_ctrl_c_works_after_an_interrupted_training(config, monkeypatch):
    pressing_in_step(monkeypatch, number=3, presses=1)
    with pytest.raises(TrainingInterrupted):
        script.train(config)
    with pytest.raises(KeyboardInterrupt):
        press()


def test_outside_the_main_thread_ctrl_c_is_left_alone():
    handlers = []

    def work():
        with Interrupt() as interrupt:
            handlers.append((signal.getsignal(signal.SIGINT), interrupt.requested))

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert handlers == [(signal.default_int_handler, False)]


def test_ctrl_c_is_recorded_while_another_thread_works():
    done = threading.Event()
    with Interrupt() as interrupt:
        worker = threading.Thread(target=done.wait)
        worker.start()
        press()
        done.set()
        worker.join()
        assert interrupt.requested


def test_ctrl_c_while_a_start_is_prepared_says_that_nothing_was_saved(config, monkeypatch, capsys):
    monkeypatch.setattr(script, "prepare_start", lambda *_: press())
    monkeypatch.setattr(command, "parse", lambda *_: config)
    assert command.main([]) == 130
    assert capsys.readouterr().err == f"train.py: {script.BEFORE}\n"
    assert not config.out.exists()


def test_ctrl_c_while_a_run_is_opened_again_says_that_it_is_as_it_was(config, monkeypatch, capsys):
    pressing_in_step(monkeypatch, number=5, presses=1)
    with pytest.raises(TrainingInterrupted):
        script.train(config)
    monkeypatch.setattr(script, "prepare_again", lambda *_: press())
    assert command.main(["--resume", str(config.out)]) == 130
    assert capsys.readouterr().err.endswith(
        ": stopped before the next iteration, the run is as it was: give the same command again\n"
    )


def test_ctrl_c_in_the_fit_of_what_moves_says_what_is_lost(config, monkeypatch, capsys):
    def start(*arguments):
        press()
        return None if arguments[-1](0.5) else pytest.fail("not stopped")

    config = dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, fit_motion=3))
    monkeypatch.setattr(trainer, "dynamic_start", start)
    monkeypatch.setattr(command, "parse", lambda *_: config)
    assert command.main([]) == 130
    first = checkpoint.load(checkpoint.list_checkpoints(config.out)[-1]).metadata.iteration
    goes_on = f"continue with warpgs train --resume {config.out}, which begins the fit of what moves anew"
    assert f"stopped after iteration {first} of {tiny.LENGTH}; {goes_on}\n" in capsys.readouterr().err
