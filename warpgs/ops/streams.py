"""Work that the GPU does at the same time."""

import threading
from collections.abc import Callable
from typing import TypeVar

import torch

from . import profiling

A = TypeVar("A")
B = TypeVar("B")

_streams = threading.local()


def side_by_side(device: torch.device, first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """Runs two functions, on CUDA at the same time; autograd goes their ways back at the same time, too.

    For work of many small launches beside work that fills the GPU. What the first reads must stay alive until both are
    done, and neither may change what the other reads.

    Args:
        device: Where both work.
        first: Runs on a stream of its own.
        second: Runs on the current stream.
    """
    if device.type != "cuda" or profiling.is_on():
        return first(), second()
    main, side = torch.cuda.current_stream(device), _side_stream(device)
    side.wait_stream(main)
    with torch.cuda.stream(side):
        one = first()
    other = second()
    main.wait_stream(side)
    return one, other


def _side_stream(device: torch.device) -> torch.cuda.Stream:
    """A second stream of this thread; threads share none, because one may be capturing a graph."""
    streams = _streams.__dict__
    if str(device) not in streams:
        streams[str(device)] = torch.cuda.Stream(device)
    return streams[str(device)]
