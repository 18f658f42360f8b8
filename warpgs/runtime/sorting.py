"""Warp's radix sort on torch tensors, also during a CUDA graph capture."""

import contextlib
import functools
import threading

import torch
import warp as wp
from torch import Tensor

from . import profiling
from .launch import current_stream

_warp_stream = threading.Lock()
"""Held while Warp's current stream, which all threads share, is changed: Warp sorts on that stream."""


def sort_pairs(keys: Tensor, values: Tensor, count: int, num_bits: int) -> None:
    """Sorts the first ``count`` int32 pairs by the low bits of the keys, stably; buffers hold twice that many."""
    device = wp.device_from_torch(keys.device)
    pairs = [_int_array(t.data_ptr(), t.numel(), device.alias) for t in (keys, values)]
    with profiling.span("sort_pairs", keys.device):
        if keys.device.type == "cpu":
            wp.utils.radix_sort_pairs(*pairs, count, 0, num_bits)
            return
        stream = current_stream(keys.device)
        with _warp_stream:
            previous = device.stream
            device.set_stream(stream, sync=False)  # a capture forbids to wait for another stream
            try:
                with _announced_capture(stream):
                    wp.utils.radix_sort_pairs(*pairs, count, 0, num_bits)
            finally:
                device.set_stream(previous, sync=False)


def _announced_capture(stream: wp.Stream) -> contextlib.AbstractContextManager[object]:
    """Tells Warp that a stream is being captured, so that the graph owns the scratch memory of the sort."""
    if not torch.cuda.is_current_stream_capturing():
        return contextlib.nullcontext()
    return wp.ScopedCapture(stream=stream, external=True, force_module_load=False)


@functools.lru_cache(maxsize=256)
def _int_array(pointer: int, size: int, device: str) -> wp.array:
    """A Warp array over memory of torch; cached, because torch's allocator reuses the same blocks."""
    return wp.array(ptr=pointer, dtype=wp.int32, shape=(size,), device=device)
