"""Work that the GPU does at the same time."""

import contextlib
import threading
from collections.abc import Iterator

import torch

from . import profiling

_streams = threading.local()


@contextlib.contextmanager
def beside(device: torch.device) -> Iterator[torch.cuda.Stream | None]:
    """What is done inside runs beside what comes after it; autograd goes the ways back at the same time, too.

    Gives the stream that the current one has to wait for before it uses what was made inside; None where it need not:
    on CPU, or while a profile is taken. What was read inside must stay alive until then, and unchanged.
    """
    if device.type != "cuda" or profiling.is_on():
        yield None
        return
    stream = _side_stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        yield stream


def _side_stream(device: torch.device) -> torch.cuda.Stream:
    """A second stream of this thread; threads share none, because one may be capturing a graph."""
    streams = _streams.__dict__
    if str(device) not in streams:
        streams[str(device)] = torch.cuda.Stream(device)
    return streams[str(device)]
