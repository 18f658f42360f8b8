"""CUDA graphs: work that is recorded once and replayed with a single launch."""

import contextlib
import gc
import threading
from collections.abc import Callable, Hashable, Iterator
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from .streams import PRIORITY, side_stream

WARM_UPS = 3
"""Eager runs before a capture: they compile kernels, allocate scratch memory and learn the number of intersections."""

_one_capture = threading.RLock()
"""Held during a capture, in which no thread may wait for the whole GPU, as another capture would."""

Key = TypeVar("Key", bound=Hashable)
Replay = Callable[[], tuple[Tensor, ...]]


class GraphCache(Generic[Key]):
    """CUDA graphs by key: the work of a key is run eagerly ``WARM_UPS`` times, then captured once and replayed.

    The key must contain everything that the work branches on. Everything else that changes between runs must be read
    from tensors that stay at the same addresses.

    Args:
        max_graphs: Maximum number of graphs; the oldest one is dropped for a new one.
        repeatable: Whether the work may be repeated without an effect, as a frame may. Its first run then warms up and
            captures at once, on the calling thread, which is the one that learns the number of intersections. Work that
            must not be repeated, such as a training step, is eager in its first ``WARM_UPS`` runs instead.
        shared_memory: Device on which all graphs share one memory pool and one stream, so that a new graph reuses the
            memory of the one before it; for ``max_graphs`` = 1. None: each graph has its own memory.
    """

    def __init__(self, max_graphs: int, repeatable: bool, shared_memory: torch.device | None = None) -> None:
        self._max_graphs, self._repeatable = max_graphs, repeatable
        self._replays: dict[Key, Replay] = {}
        self._stale: set[Key] = set()
        self._runs: dict[Key, int] = {}
        self._pool = torch.cuda.graph_pool_handle() if shared_memory is not None else None
        self._stream = None if shared_memory is None else torch.cuda.Stream(shared_memory, priority=PRIORITY)

    def is_captured(self, key: Key) -> bool:
        """Whether the next run of this key is a replay."""
        return key in self._replays and key not in self._stale

    def invalidate(self) -> None:
        """Makes the next run of every key capture again, because tensors that the work reads were replaced.

        The old graphs stay in memory until then, and the new captures reuse that memory.
        """
        self._stale.update(self._replays)

    def run(self, key: Key, work: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Runs the work, eagerly or as a replay.

        Args:
            key: Everything that ``work`` branches on.
            work: Runs on the current CUDA device without reading anything back from it.

        Returns:
            The results of ``work``; replays return the same tensors every time, with new values.
        """
        if not self.is_captured(key):
            if not self._repeatable and self._runs.get(key, 0) < WARM_UPS:
                self._runs[key] = self._runs.get(key, 0) + 1
                return work()
            if self._pool is None:
                self._drop_oldest(self._max_graphs - 1)
            # A capture with shared memory takes over that of the old graph, which must live until then.
            replay = capture(work) if self._repeatable else record(work, self._stream, self._pool)
            self._replays.pop(key, None)
            self._replays[key] = replay
            self._stale.discard(key)
            self._drop_oldest(self._max_graphs)
        return self._replays[key]()

    def _drop_oldest(self, max_graphs: int) -> None:
        while len(self._replays) > max_graphs:
            key = next(iter(self._replays))
            del self._replays[key]
            self._stale.discard(key)


def capture(step: Callable[[], tuple[Tensor, ...]]) -> Replay:
    """Captures ``step`` in a CUDA graph and returns a function that replays it.

    The replay runs on torch's current stream and returns the same tensors every time, with new values. The graph holds
    addresses, not tensors: the inputs of ``step`` must stay alive and may only be modified in place. Scalars and sizes
    of images and buffers are those of the capture, before which ``step`` is run ``WARM_UPS`` times.

    Args:
        step: Runs on the current CUDA device without reading anything back from it.
    """
    stream = torch.cuda.Stream(priority=PRIORITY)
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UPS):
            step()
    return record(step, stream)


def record(
    work: Callable[[], tuple[Tensor, ...]], stream: torch.cuda.Stream | None = None, pool: Any | None = None
) -> Replay:
    """Captures work that must not be repeated for warming up: it must have run ``WARM_UPS`` times before.

    Args:
        work: Runs on the current CUDA device without reading anything back from it.
        stream: The stream to capture on; a new one by default.
        pool: From ``torch.cuda.graph_pool_handle()``. Graphs with the same pool and stream share memory: only one of
            them may be in use, and a new one reuses the memory of the one before it, which avoids slow allocations by
            the driver.
    """
    stream = stream or torch.cuda.Stream(priority=PRIORITY)
    graph = torch.cuda.CUDAGraph()
    with _one_capture:
        torch.cuda.synchronize()
        # ``torch.cuda.graph`` always frees what torch caches, which then has to be allocated anew.
        if torch.cuda.mem_get_info()[0] < torch.cuda.memory_reserved() - torch.cuda.memory_allocated():
            torch.cuda.empty_cache()
        with torch.cuda.stream(stream):
            side_stream(stream.device)  # created here, because a capture cannot create streams
            with _without_collection():
                graph.capture_begin(pool, capture_error_mode="thread_local")  # other threads may go on using the GPU
                try:
                    outputs = work()
                except BaseException:
                    with contextlib.suppress(RuntimeError):  # an error of the work often makes its capture invalid
                        graph.capture_end()
                    raise
                graph.capture_end()

    def replay() -> tuple[Tensor, ...]:
        graph.replay()
        return outputs

    return replay


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """No garbage is collected: freeing the memory of another graph makes a capture invalid."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
