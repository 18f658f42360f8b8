"""Streams: what the GPU does at the same time, and what goes first."""

import contextlib
import threading
from collections.abc import Iterator

import torch

from . import profiling

PRIORITY = -1
"""Of work that others wait for; 0, the lowest, is that of what runs beside it. Else large matrix products would let
none of many small kernels in."""

WARP_STREAM = threading.RLock()
"""Held by who changes Warp's current stream, which is one for all threads, unlike torch's."""

_streams = threading.local()


def side_stream(device: torch.device) -> torch.cuda.Stream:
    """A second stream of this thread beside the current one.

    Threads share none, because one may be capturing a graph, and neither do two current streams: memory that is freed
    is handed out again to what waits for one of them alone.
    """
    key = f"{torch.cuda.current_stream(device).cuda_stream} on {device}"
    streams = _streams.__dict__
    if key not in streams:
        streams[key] = torch.cuda.Stream(device)
    return streams[key]


@contextlib.contextmanager
def on_side_stream(device: torch.device) -> Iterator[torch.cuda.Stream | None]:
    """What is done inside runs beside what comes after it; autograd goes the ways back at the same time, too.

    Gives the stream that the current one has to ``join`` before it uses what was made inside; None where it need not:
    on CPU, or while a profile is taken. What was read inside must stay alive until then, and unchanged.
    """
    if device.type != "cuda" or profiling.is_on():
        yield None
        return
    stream = side_stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        yield stream


def join(stream: torch.cuda.Stream | None) -> None:
    """Makes the current stream wait for what ``on_side_stream`` gave."""
    if stream is not None:
        torch.cuda.current_stream(stream.device).wait_stream(stream)


def join_captured(device: torch.device) -> None:
    """Joins what a failed capture left beside it: else its end complains of that, not of what is wrong."""
    stream = side_stream(device)
    with torch.cuda.stream(stream):
        is_captured = torch.cuda.is_current_stream_capturing()
    if is_captured:
        join(stream)
