"""CUDA streams: concurrent work and its priorities."""

import contextlib
import threading
from collections.abc import Iterator

import torch

from . import profiling

PRIORITY = -1
"""Priority of the main work; concurrent work has 0, the lowest. With equal priorities, large matrix products of the
concurrent work would delay many small kernels."""

_streams = threading.local()


def side_stream(device: torch.device) -> torch.cuda.Stream:
    """This thread's stream for work that is concurrent to the current stream.

    Each thread has its own, because another thread may be capturing a graph, and so has each current stream, because
    freed memory is reused by work that waits for only one of them.
    """
    current = torch.cuda.current_stream(device)
    key = f"{current.cuda_stream} on {current.device}"  # ``device`` may have no index
    streams = _streams.__dict__
    if key not in streams:
        streams[key] = torch.cuda.Stream(device)
    return streams[key]


@contextlib.contextmanager
def concurrently(device: torch.device) -> Iterator[contextlib.AbstractContextManager[object]]:
    """A body with work that is concurrent to the rest of it; autograd runs their backward passes concurrently, too.

    Yields:
        Context of the concurrent work, to be entered once. The current stream waits for that work at the end of the
        body, also after an error: it would be hidden by that of a CUDA graph capture with work that nothing waits for.
        On CPU, and while a profile is active, there is no concurrency.
    """
    if device.type != "cuda" or profiling.is_on():
        yield contextlib.nullcontext()
        return
    current, side = torch.cuda.current_stream(device), side_stream(device)
    side.wait_stream(current)
    try:
        yield torch.cuda.stream(side)
    finally:
        current.wait_stream(side)
