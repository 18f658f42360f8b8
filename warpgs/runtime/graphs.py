"""CUDA graphs: work recorded once and replayed with one launch."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
import warp as wp
from torch import Tensor

from .streams import PRIORITY, WARP_STREAM, join_captured, side_stream

WARM_UPS = 3
"""Runs before the capture: they compile kernels, allocate scratch memory and learn how many intersections to expect."""

Key = TypeVar("Key", bound=Hashable)


@dataclass
class _Captured:
    """A graph and the tensors that each replay fills."""

    replay: Callable[[], None] | None = None
    outputs: tuple[Tensor, ...] = ()


class GraphCache(Generic[Key]):
    """CUDA graphs by key: work is run eagerly a few times for each key, then captured once and replayed.

    The key must say everything that the work branches on. Whatever else changes between runs is read from tensors
    that stay at their addresses. On a key's first ``WARM_UPS`` runs the work runs eagerly: they compile kernels,
    allocate scratch memory and learn how many intersections to expect.

    Args:
        max_graphs: Graphs to keep; the one that was captured first is dropped for another.
        shared_memory: Device on which all graphs share one pool of memory and one stream, so that a new graph takes
            over the memory of the one before it; for ``max_graphs`` = 1. None: each graph has memory of its own.
    """

    def __init__(self, max_graphs: int, shared_memory: torch.device | None = None) -> None:
        self._max_graphs = max_graphs
        self._graphs: dict[Key, _Captured] = {}
        self._stale: set[Key] = set()
        self._runs: dict[Key, int] = {}
        self._pool = torch.cuda.graph_pool_handle() if shared_memory is not None else None
        self._stream = None if shared_memory is None else torch.cuda.Stream(shared_memory, priority=PRIORITY)

    def is_captured(self, key: Key) -> bool:
        """Whether the next run of this key is a replay."""
        return key in self._graphs and key not in self._stale

    def invalidate(self) -> None:
        """Captures every key again on its next run, because tensors that the work reads were replaced.

        The graphs stay in memory until then: the new capture takes that memory over.
        """
        self._stale.update(self._graphs)

    def run(self, key: Key, work: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Runs the work, eagerly or as a replay.

        Args:
            key: Everything that ``work`` branches on.
            work: Works on the current CUDA device without reading anything back from it.

        Returns:
            What ``work`` returns; from a replay the same tensors every time, with new values.
        """
        if self.is_captured(key):
            captured = self._graphs[key]
        elif self._runs.get(key, 0) < WARM_UPS:
            self._runs[key] = self._runs.get(key, 0) + 1
            return work()
        else:
            captured = self._capture(key, work)
        assert captured.replay is not None
        captured.replay()
        return captured.outputs

    def _capture(self, key: Key, work: Callable[[], tuple[Tensor, ...]]) -> _Captured:
        captured = _Captured()

        def fill_outputs() -> None:
            captured.outputs = work()

        captured.replay = record(fill_outputs, self._stream, self._pool)
        self._graphs.pop(key, None)  # only now: its memory was taken over
        self._graphs[key] = captured
        self._stale.discard(key)
        while len(self._graphs) > self._max_graphs:
            dropped = next(iter(self._graphs))
            del self._graphs[dropped]
            self._stale.discard(dropped)
        return captured


def capture(step: Callable[[], tuple[Tensor, ...]]) -> Callable[[], tuple[Tensor, ...]]:
    """Captures ``step`` in a CUDA graph and returns a function that replays it.

    The replay runs on torch's current stream and returns the same tensors every time, with new values. The graph holds
    addresses, not tensors: what ``step`` reads must stay alive and may only be changed in place. Scalars, image sizes
    and the size of the buffers for intersections are those of the capture; a replay with more intersections than these
    buffers hold is still drawn in full, but slowly.

    A capture must not wait for the device, which ``render`` does on the first frame of an image size on each thread, to
    learn the number of intersections. So ``step`` is first run a few times, on this thread and on the stream that the
    capture uses. (The way back runs on autograd's own thread, where nothing waits.)

    Args:
        step: Works on the current CUDA device without reading anything back from it.
    """
    outputs: tuple[Tensor, ...] = ()

    def work() -> None:
        nonlocal outputs
        outputs = step()

    stream = torch.cuda.Stream(priority=PRIORITY)
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UPS):
            work()
    replay = record(work, stream)

    def replay_outputs() -> tuple[Tensor, ...]:
        replay()
        return outputs

    return replay_outputs


def record(
    work: Callable[[], None], stream: torch.cuda.Stream | None = None, pool: Any | None = None
) -> Callable[[], None]:
    """Records ``work`` in a CUDA graph without running it, and returns a function that runs it.

    As ``capture``, for work that changes tensors in place and must not be repeated for warming up: it has to have run
    a few times before.

    Args:
        work: Works on the current CUDA device without reading anything back from it.
        stream: To capture on; a new one by default.
        pool: From ``torch.cuda.graph_pool_handle()``. Graphs that share one, and the stream, share memory: only one of
            them may be in use, and a new one takes over what the one before it had, which spares the driver's slow
            allocation.
    """
    stream = stream or torch.cuda.Stream(priority=PRIORITY)
    graph = torch.cuda.CUDAGraph()
    with WARP_STREAM:  # one capture at a time: nobody may wait for the whole GPU while there is one
        torch.cuda.synchronize()
        _record(work, graph, stream, pool)
    return graph.replay


def _record(work: Callable[[], None], graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream, pool: Any) -> None:
    warp_stream = wp.stream_from_torch(stream)
    with torch.cuda.stream(stream):
        side_stream(stream.device)  # to be there before the capture: nothing is made in one
    current = torch.cuda.current_stream()
    try:
        # Autograd's thread does the way back, so a capture that forbids calls on all threads but this one would fail.
        with (
            torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode="thread_local"),
            wp.ScopedStream(warp_stream, sync_enter=False),
            wp.ScopedCapture(stream=warp_stream, external=True, force_module_load=False),
        ):
            try:
                work()
            except BaseException:
                join_captured(stream.device)
                raise
    finally:
        torch.cuda.set_stream(current)  # torch leaves its own behind where the end of a capture fails
