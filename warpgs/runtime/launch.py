"""Launching Warp kernels on torch tensors.

Kernels run on torch's current stream. A launch is recorded once per thread and kernel, and its arguments are
overwritten in place afterwards, which costs the host less than ``wp.launch``. On CPU a launch is cut into shards for
all cores.
"""

import ctypes
import functools
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import kernel_cache, profiling

kernel_cache.init_warp()

BLOCK_DIM = 256
"""Threads per CUDA block, unless a kernel needs another number."""

CHUNKS_PER_SHARD = 16
"""Chunks per core that a CPU launch is split into; cores take them in turn, so that their work is balanced."""

MIN_SHARD = 16384
"""A CPU launch with less work than this, in plain threads, uses a single core."""

LITTLE_WORK = 1 / 16
"""Work of a thread that only copies a few numbers, relative to a plain thread."""

MAX_SMALL_IMAGE_PIXELS = 1 << 18
"""Images of at most this number of pixels are small."""

CPU = -1
"""Index of the CPU among devices (``Tensor.get_device()``, which the host obtains faster than ``Tensor.device``)."""

_CORES = os.cpu_count() or 1


def num_shards(tensor: Tensor) -> int:
    """Number of cores that a launch uses on the device of a tensor: ``torch.get_num_threads()`` on CPU, 1 on CUDA."""
    return 1 if tensor.is_cuda else _num_cores()


def is_small(size: tuple[int, int]) -> bool:
    """Whether an image of a size (width, height) should be split into smaller pieces on a GPU, to keep it busy."""
    return size[0] * size[1] <= MAX_SMALL_IMAGE_PIXELS


def _num_cores() -> int:
    return max(1, min(torch.get_num_threads(), _CORES))


def launch(
    kernel: wp.Kernel,
    dim: int,
    *arguments: Any,
    per_shard: tuple[Tensor | None, ...] = (),
    block_dim: int = BLOCK_DIM,
    work: int | float = 1,
) -> None:
    """Launches ``dim`` threads of a kernel on the device of its arguments, on torch's current stream.

    Args:
        kernel: Its first parameter is ``first``, the index of the first thread.
        dim: Number of threads.
        arguments: Of the parameters after ``first``: contiguous tensors, the first argument among them, numbers, tuples
            for vectors of as many, or None for an empty array. More axes than an array of the kernel has are leading
            axes, which are flattened.
        per_shard: The last arguments: tensors [``num_shards``, …] of which each CPU shard gets its own slice, because
            Warp's atomics are not atomic on CPU.
        block_dim: Threads per CUDA block.
        work: Work of one of its threads relative to a plain thread, to decide how many cores a CPU launch uses.
    """
    if dim == 0:
        return
    begun = profiling.begin(arguments[0])  # a context manager takes the host longer, even one that does nothing
    index = arguments[0].get_device()
    if index == CPU:
        launch_on_cpu(kernel, dim, arguments, per_shard, work)
    else:
        command_for(kernel, index, block_dim)(dim, arguments + per_shard, current_stream(index))
    if begun is not None:
        profiling.end(kernel.func.__name__, begun, arguments[0])


def launch_on_cpu(
    kernel: wp.Kernel, dim: int, arguments: tuple[Any, ...], per_shard: tuple[Tensor | None, ...], work: int | float
) -> None:
    """Launches a kernel on one core, or cut into shards on all of them."""
    shards = _num_cores() if dim * work >= MIN_SHARD else 1
    chunk = max(1, -(-dim // (shards * CHUNKS_PER_SHARD))) if shards > 1 else dim

    def run_shard(shard: int) -> None:
        own = (*arguments, *(None if t is None else t[shard] for t in per_shard))
        command_for(kernel, CPU, 1).run_chunks(range(shard * chunk, dim, shards * chunk), chunk, dim, own)

    on_all_cores(run_shard, shards)


def on_all_cores(function: Callable[[int], None], number: int) -> None:
    """Calls ``function(0)`` to ``function(number - 1)`` at once, on this thread and those of the CPU shards, and waits.

    It helps those functions that release Python's global interpreter lock. This thread takes part, because a system
    may wake two threads on the core of the one that then waits for them.
    """
    indices = iter(range(number))

    def work() -> None:
        for index in indices:
            function(index)

    others = [_workers().submit(work) for _ in range(min(number, _num_cores()) - 1)]
    try:
        work()
    finally:
        wait(others)
    for other in others:
        other.result()


@functools.cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=_CORES, thread_name_prefix="warpgs")


def current_stream(index: int) -> wp.Stream:
    """torch's current stream on a GPU as a Warp stream."""
    handle = torch._C._cuda_getCurrentRawStream(index)  # faster than a torch.cuda.Stream
    stream = _streams.get((index, handle))
    if stream is None:
        stream = _streams[index, handle] = wp.Stream(wp.get_cuda_device(index), cuda_stream=handle)
    return stream


_streams: dict[tuple[int, int], wp.Stream] = {}


class Command:
    """A recorded launch of one kernel, whose arguments are overwritten in place.

    ``wp.launch`` packs and checks all arguments every time (22 µs on the host for a typical kernel, more than many
    kernels take). Here, an argument with the same shape as last time only updates a pointer, and an equal number
    nothing; types are checked when a shape or a number changes. All arrays are described in one piece of memory, which
    costs fewer cache misses than one piece for each.

    Args:
        kernel: Its first parameter is ``first``, the index of the first thread.
        device: To launch it on.
        block_dim: Threads per CUDA block.
    """

    def __init__(self, kernel: wp.Kernel, device: wp.Device, block_dim: int):
        kernel_cache.load(kernel, device, block_dim)
        blank = [_blank(a.type) for a in kernel.adj.args]
        self.launch = wp.launch(kernel, dim=1, inputs=blank, device=device, block_dim=block_dim, record_cmd=True)
        self.dim = 1
        self.arguments = kernel.adj.args[1:]
        self.known: list[Any] = [_UNKNOWN] * len(self.arguments)
        arrays = [k for k, a in enumerate(self.arguments) if hasattr(a.type, "ndim")]
        array_type: Any = type(self.launch.params[arrays[0] + 2])
        size = ctypes.sizeof(array_type)
        memory = bytearray(size * len(self.arguments))
        self.words = memoryview(memory).cast("Q")
        self.pointers: list[int | None] = [None] * len(self.arguments)
        for k in arrays:
            self.pointers[k] = (k * size + array_type.data.offset) // 8
            self.launch.set_param_at_index_from_ctype(k + 1, array_type.from_buffer(memory, k * size))
        fields = [(a.label, type(p)) for a, p in zip(kernel.adj.args, self.launch.params[1:], strict=True)]
        self.packed = type("Packed", (ctypes.Structure,), {"_fields_": fields})

    def __call__(self, dim: int, arguments: Sequence[Any], stream: wp.Stream) -> None:
        """Launches ``dim`` threads on a GPU, with tensors, numbers, tuples or None."""
        self._set_dim(dim)
        self._write(arguments)
        self.launch.launch(stream)

    def run_chunks(self, firsts: range, chunk: int, end: int, arguments: Sequence[Any]) -> None:
        """Runs ``chunk`` threads from each of ``firsts`` on, up to the thread ``end``, on this core of the CPU.

        A launch of Warp packs the arguments again, with Python's global interpreter lock, for which the other cores
        would wait.
        """
        self._write(arguments)
        packed = self.packed(*self.launch.params[1:])
        for first in firsts:
            self._set_dim(min(chunk, end - first))
            packed.first = first
            self.launch.hooks.forward(ctypes.byref(self.launch.bounds), ctypes.byref(packed))

    def _set_dim(self, dim: int) -> None:
        if dim != self.dim:
            self.launch.set_dim(dim)
            self.dim = dim

    def _write(self, arguments: Sequence[Any]) -> None:
        """Writes addresses, and what else differs from the last launch."""
        words, is_known = self.words, len(arguments) == len(self.known)
        for value, known, pointer in zip(arguments, self.known, self.pointers):  # noqa: B905 - strict takes longer
            if pointer is None or value is None:
                is_known = is_known and value == known
            else:
                words[pointer] = value.data_ptr()
                is_known = is_known and value.shape == known
        if not is_known:
            self._describe(arguments)

    def _describe(self, arguments: Sequence[Any]) -> None:
        """Writes all numbers and the shapes of all tensors."""
        slots = self.launch.params[2:]
        for k, (slot, argument, value) in enumerate(zip(slots, self.arguments, arguments, strict=True)):
            if self.pointers[k] is not None:
                _describe(argument, slot, value)
                self.known[k] = None if value is None else value.shape
            elif isinstance(value, Tensor):
                raise TypeError(f"kernel argument {argument.label} is a number, got a tensor")
            elif isinstance(value, tuple):
                slot[:] = self.known[k] = value
            else:
                slot.value = self.known[k] = value


def _blank(type: Any) -> Any:
    """A value to record a launch with: no array, or zeros."""
    return None if hasattr(type, "ndim") else type() if hasattr(type, "_shape_") else 0


_UNKNOWN = object()
"""The known value of an argument before the first launch."""


def _describe(argument: Any, slot: Any, tensor: Tensor | None) -> None:
    """Writes the shape and strides of a tensor to a kernel argument, after checking that they fit the kernel."""
    if tensor is None:
        # All sizes become zero: kernels recognize an array that is missing by one of them.
        ctypes.memset(ctypes.addressof(slot), 0, ctypes.sizeof(slot))
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


class _Commands(threading.local):
    """The commands of this thread, by kernel, index of the device and block size."""

    def __init__(self) -> None:
        self.cache: dict[tuple[wp.Kernel, int, int], Command] = {}


_commands = _Commands()
_load_lock = threading.Lock()


def command_for(kernel: wp.Kernel, index: int, block_dim: int) -> Command:
    """This thread's command for a kernel. Each thread has its own, so that a viewer can render while a scene trains."""
    command = _commands.cache.get((kernel, index, block_dim))
    if command is None:
        device = wp.get_device("cpu") if index == CPU else wp.get_cuda_device(index)
        with _load_lock:  # two threads that load the same module at once would unload each other's code
            command = _commands.cache[kernel, index, block_dim] = Command(kernel, device, block_dim)
    return command
