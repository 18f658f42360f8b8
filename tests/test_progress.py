"""Progress is for people: where nobody looks, nothing is drawn."""

import os
import select

import rich

from warpgs import progress as module
from warpgs.progress import progress


def drawn_on_a_terminal(monkeypatch, **options):
    """What a terminal is sent while two items are gone through."""
    screen, end = os.openpty()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(rich, "_console", None)  # the one that there is has seen no terminal
    with open(end, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(module.sys, "stdout", stream)
        list(progress([1, 2], "counting", **options))
        sent = os.read(screen, 1 << 16).decode() if select.select([screen], [], [], 0.2)[0] else ""
    os.close(screen)
    return sent


def test_items_come_in_their_order():
    assert list(progress([3, 1, 2], "counting")) == [3, 1, 2]


def test_a_terminal_shows_a_bar_under_its_label(monkeypatch):
    assert "counting" in drawn_on_a_terminal(monkeypatch)


def test_a_terminal_stays_empty_if_it_should_be_quiet(monkeypatch):
    assert drawn_on_a_terminal(monkeypatch, quiet=True) == ""


def test_what_is_no_terminal_gets_neither_a_bar_nor_colours_nor_empty_lines(capsys):
    list(progress([1, 2], "counting"))
    assert capsys.readouterr().out == ""
