"""Progress bars are shown on terminals only."""

import os
import select

import pytest
import rich

from warpgs.command_line import progress as module
from warpgs.command_line.progress import AS_LINES, progress, progress_of_steps


def everything_on(screen) -> str:
    sent = b""
    while select.select([screen], [], [], 0.2)[0]:  # what was written may come in parts
        sent += os.read(screen, 1 << 16)
    os.close(screen)
    return sent.decode()


def shown_on_a_terminal(monkeypatch, run, **options) -> str:
    """What a function shows."""
    screen, end = os.openpty()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(rich, "_console", None)  # the existing console has detected that there is no terminal
    with open(end, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(module.sys, "stdout", stream)
        run(**options)
        return everything_on(screen)


def two_items(**options):
    return list(progress([3, 1], "counting", **options))


def two_steps(**options):
    with progress_of_steps(**options) as show:
        show("sawing", 1, 4)
        show("planing", 2, 4)


def test_the_last_step_is_shown_with_its_fraction(monkeypatch):
    sent = shown_on_a_terminal(monkeypatch, two_steps)
    assert "planing" in sent
    assert "50%" in sent


def test_a_terminal_shows_a_bar_with_its_label(monkeypatch):
    assert "counting" in shown_on_a_terminal(monkeypatch, two_items)


@pytest.mark.parametrize("run", [two_items, two_steps])
def test_quiet_shows_nothing_on_a_terminal(monkeypatch, run):
    assert shown_on_a_terminal(monkeypatch, run, quiet=True) == ""


def test_items_keep_their_order_and_nothing_is_written_if_stdout_is_not_a_terminal(capsys):
    assert two_items() == [3, 1]
    assert capsys.readouterr().out == ""


def test_progress_is_written_as_lines_where_the_environment_asks_for_it(capsys, monkeypatch):
    monkeypatch.setenv(AS_LINES, "1")
    assert list(progress(["a", "b"], "rendering")) == ["a", "b"]
    assert capsys.readouterr().err.splitlines() == ["rendering 0/2", "rendering 1/2", "rendering 2/2"]
    assert list(progress(["a"], "rendering", quiet=True)) == ["a"]
    assert capsys.readouterr().err == ""
