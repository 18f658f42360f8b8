"""Progress of anything longer than a second."""

import sys
from collections.abc import Collection, Iterator
from typing import TypeVar

from rich.progress import track

Item = TypeVar("Item")


def progress(items: Collection[Item], label: str, quiet: bool = False) -> Iterator[Item]:
    """The items, under a progress bar where stdout is a terminal."""
    yield from track(items, label, total=len(items), disable=quiet or not sys.stdout.isatty(), transient=True)
