"""Progress bars."""

import os
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.progress import Progress, TaskID, track

Item = TypeVar("Item")


AS_LINES = "WARPGS_PROGRESS_LINES"
"""Variable of the environment by which a process asks another one to write its progress to stderr, as lines."""


def progress(items: Collection[Item], label: str, quiet: bool = False) -> Iterator[Item]:
    """Yields the items; shows a progress bar while it does, if stdout is a terminal and ``quiet`` is false.

    With ``AS_LINES`` in the environment it writes a line "label done/total" for each item instead.
    """
    if os.environ.get(AS_LINES) and not quiet:
        for done, item in enumerate(items):
            _write_line(label, done, len(items))
            yield item
        _write_line(label, len(items), len(items))
        return
    yield from track(items, label, total=len(items), disable=quiet or not sys.stdout.isatty(), transient=True)


def _write_line(label: str, done: int, total: int) -> None:
    sys.stderr.write(f"{label} {done}/{total}\n")
    sys.stderr.flush()


@contextmanager
def progress_of_steps(quiet: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """A function that shows a progress bar for each label; it takes the label, how much is done, and of how much.

    Nothing is shown if stdout is not a terminal or ``quiet`` is true.
    """
    with Progress(disable=quiet or not sys.stdout.isatty(), transient=True) as bars:
        tasks: dict[str, TaskID] = {}

        def show(label: str, done: int, total: int) -> None:
            for other, task in tasks.items():
                if other != label:
                    bars.update(task, visible=False)
            if label not in tasks:
                tasks[label] = bars.add_task(label, total=total)
            bars.update(tasks[label], completed=done, total=total, visible=True)

        yield show
