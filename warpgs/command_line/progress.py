"""Progress bars."""

import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.progress import Progress, TaskID, track

Item = TypeVar("Item")


def progress(items: Collection[Item], label: str, quiet: bool = False) -> Iterator[Item]:
    """Yields the items; shows a progress bar while it does, if stdout is a terminal and ``quiet`` is false."""
    yield from track(items, label, total=len(items), disable=quiet or not sys.stdout.isatty(), transient=True)


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
