"""Progress bars."""

import sys
from collections.abc import Collection, Iterator
from typing import TypeVar

from rich.progress import track

Item = TypeVar("Item")


def progress(items: Collection[Item], label: str, quiet: bool = False) -> Iterator[Item]:
    """Yields the items; shows a progress bar while it does, if stdout is a terminal and ``quiet`` is false."""
    yield from track(items, label, total=len(items), disable=quiet or not sys.stdout.isatty(), transient=True)
