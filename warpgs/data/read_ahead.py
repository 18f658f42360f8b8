"""Reads ahead: threads read what is needed next while the rest of the program works."""

import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Generic, TypeVar

MAX_THREADS = 16
"""Maximum number of threads; each holds one or two items in memory."""

SPARE = 2
"""Number of items that may be ready beyond those that the threads are reading."""

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")


class ReadAhead(Generic[Key, Item]):
    """Reads items by key in threads, before they are taken.

    Threads suffice for frames: OpenCV, torch and large numpy operations release the interpreter's lock. Processes that
    torchrun started share the cores of their machine.

    Args:
        read: Reads the item of a key; called by several threads at once.
        setup: Called in each thread before it reads.
    """

    def __init__(self, read: Callable[[Key], Item], setup: Callable[[], object] | None = None) -> None:
        processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        threads = max(1, min(MAX_THREADS, (os.cpu_count() or 1) // processes))
        self._read, self._max_pending = read, threads + SPARE
        self._pool = ThreadPoolExecutor(threads, "read-ahead", initializer=setup)
        self._pending: dict[Key, Future[Item]] = {}

    def announce(self, keys: Iterable[Key]) -> None:
        """Begins to read the first of these items, up to the maximum number of pending ones; discards all others."""
        wanted = list(islice(keys, self._max_pending))
        for key in self._pending.keys() - wanted:
            self.discard(key)
        for key in wanted:
            if key not in self._pending:
                self._pending[key] = self._pool.submit(self._read, key)

    def discard(self, key: Key) -> None:
        """Drops an item that was read ahead; it is read again when it is taken."""
        if key in self._pending:
            self._pending.pop(key).cancel()

    def take(self, key: Key) -> Item:
        """The item of a key, read ahead or now; raises what reading it raised."""
        future = self._pending.pop(key, None)
        return self._read(key) if future is None else future.result()

    def each(self, keys: Sequence[Key]) -> Iterator[Item]:
        """The items of these keys, one after the other."""
        for position, key in enumerate(keys):
            self.announce(keys[position:])
            yield self.take(key)
