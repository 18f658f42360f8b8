"""CUDA graphs: work recorded once and replayed with one launch."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from .streams import PRIORITY, WARP_STREAM, join_captured, side_stream

WARM_UPS = 3
"""Runs before the capture: they compile kernels, allocate scratch memory and learn how many intersections to expect."""


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
