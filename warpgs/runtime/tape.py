"""The only bridge between torch and Warp: memory, streams, launches (``commands``) and adjoints.

An op is a function ``op(run, *tensors, ...) -> tensors``. Through its ``Run`` it allocates (from torch), launches
kernels on torch's current stream, and records how to go back; ``differentiable`` wraps it into autograd. All ops of one
``differentiable`` call share one ``wp.Tape``, so a whole render crosses between torch and Warp once each way.
"""

import contextlib
import functools
import os
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import profiling
from .launch import command_for
from .streams import WARP_STREAM

wp.config.log_level = wp.LOG_WARNING
wp.init()

CHUNKS_PER_SHARD = 16
"""Pieces a core that a CPU launch is cut into and that are dealt out in turn, so that cores get like shares."""

MIN_SHARD = 16384
"""Threads below which a CPU launch is not worth another core."""

LITTLE_WORK = 1 / 16
"""What a thread that only moves a few numbers does of a plain thread's work."""

Op = Callable[..., tuple[Tensor, ...]]
"""``op(run, *tensors) -> tensors``."""

_CORES = os.cpu_count() or 1
_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()


def _workers() -> ThreadPoolExecutor:
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max_workers=_CORES, thread_name_prefix="warpgs")
        return _pool


# ---------------------------------------------------------------------------------------------------------------------
# Runs


class Run:
    """One forward pass of an op, and the way back.

    Attributes:
        device: Where the tensors live.
        needs_grad: Whether anything will ask for gradients; if not, ops keep nothing for the way back.
        num_shards: Cores that a CPU launch is spread over (``torch.get_num_threads()``); 1 on CUDA.
        filled: Outputs of the op that the way back writes to.
        read: What the way back reads and nobody may change meanwhile, if it is an output of the op.
        conditions: What has to hold for the launches to do the same job again, for other values of the tensors.
    """

    def __init__(self, device: torch.device, wanted: Sequence[Tensor]):
        self.device = device
        self.needs_grad = bool(wanted)
        self._wanted = {id(t) for t in wanted}
        self.is_cuda = device.type == "cuda"
        self.num_shards = 1 if self.is_cuda else max(1, min(torch.get_num_threads(), _CORES))
        self._warp_device = wp.device_from_torch(device)
        self.stream = self._current_stream()
        self.filled: list[Tensor] = []
        self.read: list[Tensor] = []
        self.conditions: list[Callable[[], bool]] = []
        self._tape = wp.Tape()
        self._adjoints: dict[int, Tensor | None] = {}
        self._kept: list[Tensor] = []

    def empty(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self.device)

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(shape, dtype=dtype, device=self.device)

    def wants(self, tensor: Tensor) -> bool:
        """Whether a gradient of this input of the op is asked for."""
        return id(tensor) in self._wanted

    # Going back -------------------------------------------------------------------------------------------------------

    def on_backward(self, function: Callable[["Run"], None], reads: Sequence[Tensor] = ()) -> None:
        """Records how to go back over what was just launched; called with the run, in reverse order.

        The function takes the run as its argument and must not hold it: the run holds the function, and in a cycle
        the memory of a whole render would wait for Python's garbage collector. ``reads`` are those tensors it reads
        that may be outputs of the op.
        """
        if self.needs_grad:
            self.read += reads
            this = weakref.proxy(self)
            self._tape.record_func(lambda: function(this), [])

    def adjoint(self, tensor: Tensor) -> Tensor | None:
        """What has arrived at a tensor on the way back, contiguous; None where nothing has."""
        value = self._adjoints.get(id(tensor))
        return None if value is None else value.contiguous()

    def add_adjoint(self, tensor: Tensor, value: Tensor) -> None:
        """Passes a gradient on to a tensor that an op read."""
        known = self._adjoints.get(id(tensor))
        self._adjoints[id(tensor)] = value if known is None else known + value
        self._kept.append(tensor)  # so that its id stays its own

    def backward(self, outputs: Sequence[Tensor], gradients: Sequence[Tensor | None]) -> None:
        self.stream = self._current_stream()
        self._adjoints = {id(o): g for o, g in zip(outputs, gradients, strict=True)}
        self._tape.backward()

    def forget_adjoints(self) -> None:
        """Frees what a way back has gathered; the way itself may be gone again (``retain_graph``)."""
        self._adjoints = {}
        self._kept = []

    # Launching --------------------------------------------------------------------------------------------------------

    def launch(self, kernel: wp.Kernel, dim: int, *arguments: Any, block_dim: int = 256, work: int | float = 1) -> None:
        """Runs ``dim`` threads of a kernel; ``arguments`` follow its first parameter, ``first``.

        ``work`` says how many times a plain thread's work one of these does, for sharing out CPU launches.
        """
        if dim == 0:
            return
        with profiling.span(kernel.func.__name__, self.device):
            self._launch(kernel, dim, arguments, block_dim, work)

    def launch_adjoint(
        self, kernel: wp.Kernel, dim: int, tensors: Sequence[Tensor], adjoints: Sequence[Tensor]
    ) -> None:
        """Runs the adjoint that Warp generated for a kernel: adds to the adjoints of what the kernel read.

        ``tensors`` and ``adjoints`` follow the kernel's first parameter, ``first``.
        """

        def arrays(values: Sequence[Tensor]) -> list[wp.array]:
            types = [argument.type.dtype for argument in kernel.adj.args[1:]]
            return [wp.from_torch(t.detach(), d, requires_grad=False) for t, d in zip(values, types, strict=True)]

        wp.launch(
            kernel,
            dim=dim,
            inputs=[0, *arrays(tensors)],
            adj_inputs=[0, *arrays(adjoints)],
            adjoint=True,
            device=self._warp_device,
            stream=self.stream,
        )

    def _launch(self, kernel: wp.Kernel, dim: int, arguments: Sequence[Any], block_dim: int, work: int | float) -> None:
        if self.is_cuda:
            command_for(kernel, self.device, block_dim)(dim, 0, arguments, self.stream)
            return
        shards = self.num_shards if dim * work >= MIN_SHARD else 1
        chunk = max(1, -(-dim // (shards * CHUNKS_PER_SHARD))) if shards > 1 else dim

        def run_shard(shard: int) -> None:
            command = command_for(kernel, self.device, 1)
            for first in range(shard * chunk, dim, shards * chunk):
                command(min(chunk, dim - first), first, arguments, None, shard)

        if shards == 1:
            run_shard(0)
        else:
            list(_workers().map(run_shard, range(shards)))

    def _current_stream(self) -> wp.Stream | None:
        """torch's current stream, as Warp knows it; None on CPU."""
        if not self.is_cuda:
            return None
        handle = torch.cuda.current_stream(self.device).cuda_stream
        stream = _streams.get((self.device.index, handle))
        if stream is None:
            stream = _streams[self.device.index, handle] = wp.Stream(self._warp_device, cuda_stream=handle)
        return stream

    def sort_pairs(self, keys: Tensor, values: Tensor, count: int, num_bits: int) -> None:
        """Stable radix sort of the first ``count`` int32 pairs by the low bits of the keys; buffers hold twice that."""
        device = self._warp_device
        pairs = (_int_array(t.data_ptr(), t.numel(), device.alias) for t in (keys, values))
        with profiling.span("sort_pairs", self.device):
            if not self.is_cuda:
                wp.utils.radix_sort_pairs(*pairs, count, 0, num_bits)
                return
            # Warp sorts on its own stream. No event is waited for, which a CUDA graph capture would not allow.
            # In a capture the lock is held already, by a thread that may be waiting for this one.
            with contextlib.nullcontext() if torch.cuda.is_current_stream_capturing() else WARP_STREAM:
                previous = device.stream
                device.set_stream(self.stream, sync=False)
                try:
                    wp.utils.radix_sort_pairs(*pairs, count, 0, num_bits)
                finally:
                    device.set_stream(previous, sync=False)


_streams: dict[tuple[int, int], wp.Stream] = {}


@functools.lru_cache(maxsize=256)
def _int_array(pointer: int, size: int, device: str) -> wp.array:
    """Memory that torch owns, as Warp's sort wants it; torch's allocator hands out the same blocks again and again."""
    return wp.array(ptr=pointer, dtype=wp.int32, shape=(size,), device=device)


def indices(some: Sequence[Tensor], tensors: Sequence[Tensor]) -> list[int]:
    """Where those that are among some are in a sequence of tensors."""
    return [k for k, tensor in enumerate(tensors) if any(tensor is s for s in some)]


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, op: Op, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        device = next(t.device for t in tensors if t is not None)
        ctx.run = Run(device, [t for t in tensors if t is not None and t.requires_grad])
        ctx.set_materialize_grads(False)
        ctx.raw_inputs = tensors
        ctx.raw_outputs = op(ctx.run, *tensors)
        # The outputs are handed out as aliases, because the run keeps the originals and would otherwise keep its own
        # graph alive. Saving what the way back reads makes torch notice when that is changed in place before.
        outputs = tuple(o.detach() for o in ctx.raw_outputs)
        ctx.save_for_backward(*tensors, *(outputs[k] for k in indices(ctx.run.read, ctx.raw_outputs)))
        ctx.mark_non_differentiable(*(o for o in outputs if not o.is_floating_point()))
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        with torch.no_grad():
            ctx.run.backward(ctx.raw_outputs, gradients)
            adjoints = [None if t is None else ctx.run.adjoint(t) for t in ctx.raw_inputs]
            ctx.run.forget_adjoints()
            return None, *(a if n else None for a, n in zip(adjoints, ctx.needs_input_grad[1:], strict=True))


def differentiable(op: Op, *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """Runs ``op(run, *tensors)`` and, where a tensor wants gradients, lets autograd go back through it.

    Args:
        op: Returns a tuple of tensors; those of integer type carry no gradient.
        tensors: Its inputs, all on one device, contiguous; None is passed through.
    """
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors):
        return _Differentiable.apply(op, *tensors)
    device = next(t.device for t in tensors if t is not None)
    with torch.no_grad():
        return op(Run(device, []), *tensors)


def adjoint_launch(run: Run, kernel: wp.Kernel, dim: int, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> None:
    """Launches a kernel forward and records the adjoint that Warp generated for it.

    ``inputs`` and ``outputs`` are float tensors, in the order of the kernel's parameters after ``first``.
    """
    run.launch(kernel, dim, *inputs, *outputs)

    def backward(run: Run) -> None:
        v_inputs = [torch.zeros_like(t) for t in inputs]
        v_outputs = [torch.zeros_like(t) if (v := run.adjoint(t)) is None else v for t in outputs]
        if dim > 0:
            run.launch_adjoint(kernel, dim, [*inputs, *outputs], [*v_inputs, *v_outputs])
        for tensor, value in zip(inputs, v_inputs, strict=True):
            run.add_adjoint(tensor, value)

    run.on_backward(backward)


def pinned_counter(device: torch.device) -> Tensor:
    """One int64 in host memory that a kernel on ``device`` can write to, zero at first."""
    counter = torch.zeros(1, dtype=torch.int64)
    return counter.pin_memory() if device.type == "cuda" else counter
