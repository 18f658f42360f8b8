"""Text for people: on a terminal, lines break between words; in files and pipes they stay whole."""

import re
import shutil
import sys
import unicodedata
from typing import Protocol, runtime_checkable

STYLE = re.compile(r"\x1b\[[0-9;]*m")
"""Colours and weights, which take no space."""

WORD = re.compile(r" *(?:\[--[^][]*\]|[^ ]+)")
"""A word with the spaces before it; an option in brackets is one."""

START = re.compile(r"usage: | +\S+ {2,}| *")
"""Start of a line below whose end the rest of it continues."""


@runtime_checkable
class Stream(Protocol):
    """A stream of text, such as standard output."""

    def write(self, text: str, /) -> object: ...

    def flush(self) -> object: ...


def is_terminal(stream: Stream) -> bool:
    """Whether a stream is a terminal; a program's own one in place of standard error may not know."""
    return bool(getattr(stream, "isatty", bool)())


def show(text: object, file: Stream | None = None) -> None:
    """Prints a text, by default on standard output."""
    stream = file or sys.stdout
    stream.write(f"{fitted(str(text), stream)}\n")
    stream.flush()


def show_error(text: object) -> None:
    """Prints a text on standard error."""
    show(text, sys.stderr)


def fitted(text: str, stream: Stream) -> str:
    """A text for a stream: as it is unless that is a terminal."""
    return wrapped(text) if is_terminal(stream) else text


def wrapped(text: str, columns: int | None = None) -> str:
    """A text whose lines break between words; a word that is longer than a line, as paths are, stays whole.

    Args:
        text: The text.
        columns: Width of a line; the terminal's if None.
    """
    columns = columns or shutil.get_terminal_size().columns
    return "\n".join(_wrapped(line, columns) for line in text.split("\n"))


def _wrapped(line: str, columns: int) -> str:
    if _width(line) <= columns:
        return line
    start = START.match(STYLE.sub("", line))
    indent = " " * (start.end() if start else 0)
    lines = [""]
    for word in WORD.findall(line):
        if lines[-1].strip() and _width(lines[-1] + word) > columns:
            lines.append(indent + word.lstrip(" "))
        else:
            lines[-1] += word
    return "\n".join(lines)


def _width(line: str) -> int:
    """The number of columns that a line takes; some characters take two."""
    return sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in STYLE.sub("", line))
