"""Launching Warp kernels, and its radix sort, on torch tensors.

Kernels run on torch's current stream. A launch is recorded once per thread and kernel, and its arguments are
overwritten in place afterwards, which costs the host less than ``wp.launch``. On CPU a launch is cut into shards for
all cores.
"""

import contextlib
import functools
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import kernel_cache, profiling

kernel_cache.init_warp()

CHUNKS_PER_SHARD = 16
"""Chunks per core that a CPU launch is split into; cores take them in turn, so that their work is balanced."""

MIN_SHARD = 16384
"""A CPU launch with less work than this, in plain threads, uses a single core."""

LITTLE_WORK = 1 / 16
"""Work of a thread that only copies a few numbers, relative to a plain thread."""

_CORES = os.cpu_count() or 1


def num_shards(device: torch.device) -> int:
    """Number of cores that a CPU launch uses (``torch.get_num_threads()``); 1 on CUDA."""
    return 1 if device.type == "cuda" else max(1, min(torch.get_num_threads(), _CORES))


def launch(
    kernel: wp.Kernel,
    dim: int,
    *arguments: Any,
    per_shard: Sequence[Tensor | None] = (),
    block_dim: int = 256,
    work: int | float = 1,
) -> None:
    """Launches ``dim`` threads of a kernel on the device of its arguments, on torch's current stream.

    Args:
        kernel: Its first parameter is ``first``, the index of the first thread.
        dim: Number of threads.
        arguments: Of the parameters after ``first``: contiguous tensors, the first argument among them, numbers, or
            None for an empty array. More axes than an array of the kernel has are leading axes, which are flattened.
        per_shard: The last arguments: tensors [``num_shards``, …] of which each CPU shard gets its own slice, because
            Warp's atomics are not atomic on CPU.
        block_dim: Threads per CUDA block.
        work: Work of one of its threads relative to a plain thread, to decide how many cores a CPU launch uses.
    """
    if dim == 0:
        return
    device = arguments[0].device
    with profiling.span(kernel.func.__name__, device):
        if device.type == "cuda":
            command_for(kernel, device, block_dim)(dim, 0, (*arguments, *per_shard), current_stream(device))
        else:
            launch_on_cpu(kernel, dim, arguments, per_shard, work)


def launch_on_cpu(
    kernel: wp.Kernel, dim: int, arguments: Sequence[Any], per_shard: Sequence[Tensor | None], work: int | float
) -> None:
    """Launches a kernel on one core, or cut into shards on all of them."""
    device = torch.device("cpu")
    shards = num_shards(device) if dim * work >= MIN_SHARD else 1
    chunk = max(1, -(-dim // (shards * CHUNKS_PER_SHARD))) if shards > 1 else dim

    def run_shard(shard: int) -> None:
        command = command_for(kernel, device, 1)
        own = (*arguments, *(None if t is None else t[shard] for t in per_shard))
        for first in range(shard * chunk, dim, shards * chunk):
            command(min(chunk, dim - first), first, own, None)

    on_all_cores(run_shard, shards)


def on_all_cores(function: Callable[[int], None], number: int) -> None:
    """Calls ``function(0)`` to ``function(number - 1)`` at once, on the threads of the CPU shards, and waits for them.

    It helps those functions that release Python's global interpreter lock.
    """
    if number == 1 or num_shards(torch.device("cpu")) == 1:
        for index in range(number):
            function(index)
    else:
        list(_workers().map(function, range(number)))


@functools.cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=_CORES, thread_name_prefix="warpgs")


def current_stream(device: torch.device) -> wp.Stream:
    """torch's current stream on a GPU as a Warp stream."""
    handle = torch._C._cuda_getCurrentRawStream(device.index)  # faster than a torch.cuda.Stream
    stream = _streams.get((device, handle))
    if stream is None:
        stream = _streams[device, handle] = wp.Stream(wp.device_from_torch(device), cuda_stream=handle)
    return stream


_streams: dict[tuple[torch.device, int], wp.Stream] = {}


class Command:
    """A recorded launch of one kernel, whose arguments are overwritten in place.

    ``wp.launch`` packs and checks all arguments every time (22 µs on the host for a typical kernel, more than many
    kernels take). Here, an argument with the same shape as last time only updates a pointer.

    Args:
        kernel: Its first parameter is ``first``, the index of the first thread.
        device: To launch it on.
        block_dim: Threads per CUDA block.
    """

    def __init__(self, kernel: wp.Kernel, device: wp.Device, block_dim: int):
        kernel_cache.load(kernel, device, block_dim)
        blank = [None if hasattr(a.type, "ndim") else 0 for a in kernel.adj.args]
        self.launch = wp.launch(kernel, dim=1, inputs=blank, device=device, block_dim=block_dim, record_cmd=True)
        self.dim = 1
        _bounds, self.first, *self.slots = self.launch.params
        self.arguments = kernel.adj.args[1:]
        self.shapes: list[Any] = [None if hasattr(a.type, "ndim") else _NUMBER for a in self.arguments]

    def __call__(self, dim: int, first: int, arguments: Sequence[Any], stream: wp.Stream | None) -> None:
        """Launches threads ``first`` to ``first + dim - 1``, with tensors, numbers or None (an empty array)."""
        if dim != self.dim:
            self.launch.set_dim(dim)
            self.dim = dim
        self.first.value = first
        is_known = len(arguments) == len(self.slots)
        for slot, shape, value in zip(self.slots, self.shapes, arguments):  # noqa: B905 - strict takes a tenth longer
            if shape is _NUMBER:
                slot.value = value
            elif value is not None:
                slot.data = value.data_ptr()
                is_known = is_known and value.shape == shape
            elif shape is not None:
                is_known = False
        if not is_known:
            self._describe(arguments)
        self.launch.launch(stream)

    def _describe(self, arguments: Sequence[Any]) -> None:
        """Writes the shapes of the tensors."""
        for index, (slot, argument, value) in enumerate(zip(self.slots, self.arguments, arguments, strict=True)):
            if self.shapes[index] is not _NUMBER:
                _describe(argument, slot, value)
                self.shapes[index] = None if value is None else value.shape


_NUMBER = object()
"""The shape of a kernel argument that is a number."""


def _describe(argument: Any, slot: Any, tensor: Tensor | None) -> None:
    """Writes the shape and strides of a tensor to a kernel argument, after checking that they fit the kernel."""
    if tensor is None:
        slot.data = 0
        slot.shape[0] = 0
        return
    dtype, ndim = argument.type.dtype, argument.type.ndim
    inner = tuple(getattr(dtype, "_shape_", ()))
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    flattened = tensor.ndim - ndim - len(inner)
    if wp.dtype_to_torch(scalar) != tensor.dtype or flattened < 0 or tensor.shape[flattened + ndim :] != inner:
        raise TypeError(
            f"kernel argument {argument.label} is a {ndim}-d array of {dtype.__name__}, "
            f"got {tuple(tensor.shape)} {tensor.dtype}"
        )
    if not tensor.is_contiguous():
        raise TypeError(f"kernel argument {argument.label} must be contiguous")
    sizes = math.prod(tensor.shape[: flattened + 1]), *tensor.shape[flattened + 1 : flattened + ndim]
    stride = math.prod(inner) * tensor.element_size()
    slot.ndim = ndim
    for axis in reversed(range(ndim)):
        slot.shape[axis], slot.strides[axis] = sizes[axis], stride
        stride *= sizes[axis]


_commands = threading.local()
_load_lock = threading.Lock()


def command_for(kernel: wp.Kernel, device: torch.device, block_dim: int) -> Command:
    """This thread's command for a kernel. Each thread has its own, so that a viewer can render while a scene trains."""
    try:
        return _commands.cache[kernel, device, block_dim]
    except AttributeError:
        _commands.cache = {}
    except KeyError:
        pass
    with _load_lock:  # two threads that load the same module at once would unload each other's code
        made = _commands.cache[kernel, device, block_dim] = Command(kernel, wp.device_from_torch(device), block_dim)
    return made


_warp_stream = threading.Lock()
"""Held while Warp's current stream, which all threads share, is changed: Warp sorts on that stream."""


def sort_pairs(keys: Tensor, values: Tensor, count: int, num_bits: int) -> None:
    """Sorts the first ``count`` int32 pairs by the low bits of the keys, stably; buffers hold twice that many."""
    device = keys.device
    arguments = keys.data_ptr(), values.data_ptr(), count, 0, num_bits, values.element_size()
    with profiling.span("sort_pairs", device):
        if device.type == "cpu":
            _native.wp_radix_sort_pairs_int_host(*arguments)
            return
        stream = current_stream(device)
        with _warp_stream:
            previous = stream.device.stream
            stream.device.set_stream(stream, sync=False)  # a capture forbids to wait for another stream
            try:
                with _announced_capture(stream):
                    _native.wp_radix_sort_pairs_int_device(*arguments)
            finally:
                stream.device.set_stream(previous, sync=False)


_native = wp.get_device("cpu").runtime.core
"""Warp's library: ``wp.utils.radix_sort_pairs`` takes Warp's arrays, which cost the host as much as the sort."""


def _announced_capture(stream: wp.Stream) -> contextlib.AbstractContextManager[object]:
    """Tells Warp that a stream is being captured, so that the graph owns the scratch memory of the sort."""
    if not torch.cuda.is_current_stream_capturing():
        return contextlib.nullcontext()
    return wp.ScopedCapture(stream=stream, external=True, force_module_load=False)
