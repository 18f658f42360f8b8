"""CUDA streams: concurrent work and its priorities."""

import contextlib
import threading
from collections.abc import Iterator

import torch

from . import profiling

PRIORITY = -1
"""Priority of the main work; concurrent work has 0, the lowest. With equal priorities, large matrix products of the
concurrent work would delay many small kernels."""

WARP_STREAM = threading.RLock()
"""Lock for changing Warp's current stream, which all threads share, unlike torch's."""

_streams = threading.local()


def side_stream(device: torch.device) -> torch.cuda.Stream:
    """This thread's stream for work that is concurrent to the current stream.

    Each thread has its own, because another thread may be capturing a graph, and so has each current stream, because
    freed memory is reused by work that waits for only one of them.
    """
    key = f"{torch.cuda.current_stream(device).cuda_stream} on {device}"
    streams = _streams.__dict__
    if key not in streams:
        streams[key] = torch.cuda.Stream(device)
    return streams[key]


@contextlib.contextmanager
def on_side_stream(device: torch.device) -> Iterator[torch.cuda.Stream | None]:
    """Runs the body concurrently to the code after it; autograd runs their backward passes concurrently, too.

    Tensors that the body reads must stay alive and unmodified until the streams are joined.

    Yields:
        The stream that the current stream must ``join`` before using the results; None if that is not necessary: on
        CPU, or while a profile is active.
    """
    if device.type != "cuda" or profiling.is_on():
        yield None
        return
    stream = side_stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        yield stream


def join(stream: torch.cuda.Stream | None) -> None:
    """Makes the current stream wait for a stream of ``on_side_stream``; does nothing for None."""
    if stream is not None:
        torch.cuda.current_stream(stream.device).wait_stream(stream)


def join_captured(device: torch.device) -> None:
    """Joins the side stream of a failed capture, which would otherwise hide the error that made it fail."""
    stream = side_stream(device)
    with torch.cuda.stream(stream):
        is_captured = torch.cuda.is_current_stream_capturing()
    if is_captured:
        join(stream)
