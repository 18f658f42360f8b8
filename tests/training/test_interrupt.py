"""Ctrl-C: the first is noted, the second interrupts, and what was before comes back."""

import dataclasses
import signal
import threading

import pytest

from tests import tiny
from warpgs.runs import checkpoint
from warpgs.training import command
from warpgs.training import train as script
from warpgs.training.interrupt import Interrupt
from warpgs.training.step import Step


@pytest.fixture(autouse=True)
def _as_in_a_terminal():
    """A job in the background ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press():
    signal.raise_signal(signal.SIGINT)


def test_nothing_is_wanted_before_ctrl_c():
    with Interrupt() as interrupt:
        assert not interrupt.wanted


def test_the_first_ctrl_c_is_only_noted():
    with Interrupt() as interrupt:
        press()
        assert interrupt.wanted


def test_the_second_ctrl_c_interrupts():
    with Interrupt():
        press()
        with pytest.raises(KeyboardInterrupt):
            press()


def test_a_third_ctrl_c_interrupts_too():
    with Interrupt():
        press()
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                press()


@pytest.mark.parametrize("presses", [0, 1])
def test_what_ctrl_c_did_before_comes_back(presses):
    heard = []
    signal.signal(signal.SIGINT, lambda *_: heard.append("before"))
    with Interrupt():
        for _ in range(presses):
            press()
    assert heard == []
    press()
    assert heard == ["before"]


def test_what_ctrl_c_did_before_comes_back_after_an_error():
    with pytest.raises(ValueError, match="wrong"), Interrupt():
        raise ValueError("wrong")
    with pytest.raises(KeyboardInterrupt):
        press()


def test_each_context_begins_anew():
    interrupt = Interrupt()
    with interrupt:
        press()
    with Interrupt() as another:
        assert not another.wanted


# In training --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("cache"))


@pytest.fixture
def config(data, tmp_path, contracts_off):
    return dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path / "run")


def pressing_in_step(monkeypatch, number, presses):
    """Ctrl-C in the middle of the ``number``-th step, right after its update."""
    whole, steps = Step.__call__, []

    def step(self, *arguments):
        whole(self, *arguments)
        steps.append(arguments)
        if len(steps) == number:
            for _ in range(presses):
                press()

    monkeypatch.setattr(Step, "__call__", step)


def test_after_ctrl_c_the_iteration_in_progress_ends_and_is_saved(config, monkeypatch, capsys):
    pressing_in_step(monkeypatch, number=5, presses=1)
    assert script.train(config) == 130
    assert checkpoint.load(checkpoint.list_checkpoints(config.out)[-1]).metadata.iteration == 5
    said = capsys.readouterr().err
    assert f"stopped after iteration 5 of {tiny.LENGTH}; go on with --resume {config.out}" in said


def test_a_second_ctrl_c_stops_at_once_and_leaves_whole_checkpoints(config, monkeypatch):
    pressing_in_step(monkeypatch, number=10, presses=2)
    with pytest.raises(KeyboardInterrupt):
        script.train(config)
    assert [checkpoint.load(path).metadata.iteration for path in checkpoint.list_checkpoints(config.out)] == [0, 7]
    assert script.start(command.parse(["--resume", str(config.out)])).iteration == 7


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


def test_ctrl_c_works_after_a_stopped_training(config, monkeypatch):
    pressing_in_step(monkeypatch, number=3, presses=1)
    script.train(config)
    with pytest.raises(KeyboardInterrupt):
        press()


def test_ctrl_c_is_heard_while_another_thread_works():
    done = threading.Event()
    with Interrupt() as interrupt:
        worker = threading.Thread(target=done.wait)
        worker.start()
        press()
        done.set()
        worker.join()
        assert interrupt.wanted
