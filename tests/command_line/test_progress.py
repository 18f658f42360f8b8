"""Progress bars are shown on terminals only."""

import os
import select

import rich

from warpgs.command_line import progress as module
from warpgs.command_line.progress import progress, progress_of_steps


def everything_on(screen) -> str:
    sent = b""
    while select.select([screen], [], [], 0.2)[0]:  # what was written may come in parts
        sent += os.read(screen, 1 << 16)
    os.close(screen)
    return sent.decode()


def shown_on_a_terminal(monkeypatch, **options):
    """The output on a terminal during an iteration over two items."""
    screen, end = os.openpty()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(rich, "_console", None)  # the existing console has detected that there is no terminal
    with open(end, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(module.sys, "stdout", stream)
        list(progress([1, 2], "counting", **options))
        return everything_on(screen)


def shown_in_steps(monkeypatch, **options) -> str:
    """The output of two steps on a terminal."""
    screen, end = os.openpty()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(rich, "_console", None)
    with open(end, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(module.sys, "stdout", stream)
        with progress_of_steps(**options) as show:
            show("sawing", 1, 4)
            show("planing", 2, 4)
        return everything_on(screen)


def test_the_last_step_is_shown_with_its_fraction(monkeypatch):
    sent = shown_in_steps(monkeypatch)
    assert "planing" in sent
    assert "50%" in sent


def test_quiet_steps_show_nothing(monkeypatch):
    assert shown_in_steps(monkeypatch, quiet=True) == ""


def test_items_keep_their_order():
    assert list(progress([3, 1, 2], "counting")) == [3, 1, 2]


def test_a_terminal_shows_a_bar_with_its_label(monkeypatch):
    assert "counting" in shown_on_a_terminal(monkeypatch)


def test_quiet_shows_nothing_on_a_terminal(monkeypatch):
    assert shown_on_a_terminal(monkeypatch, quiet=True) == ""


def test_nothing_is_written_if_stdout_is_not_a_terminal(capsys):
    list(progress([1, 2], "counting"))
    assert capsys.readouterr().out == ""
