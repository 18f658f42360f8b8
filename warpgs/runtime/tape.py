"""The bridge between torch and Warp: memory, streams, launches and gradients.

An op is a function ``op(ctx, *tensors) -> tensors``. Through its ``OpContext`` it allocates memory (from torch),
launches kernels on torch's current stream and records its backward pass; ``differentiable`` makes it an autograd node.
All parts of one ``differentiable`` call share one ``wp.Tape``, so that a whole render is a single node.
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
from torch.autograd.function import once_differentiable

from . import profiling
from .kernel_cache import init_warp
from .launch import command_for
from .streams import WARP_STREAM

init_warp()

CHUNKS_PER_SHARD = 16
"""Chunks per core that a CPU launch is split into; cores take them in turn, so that their work is balanced."""

MIN_SHARD = 16384
"""A CPU launch with less work than this, in plain threads, uses a single core."""

LITTLE_WORK = 1 / 16
"""Work of a thread that only copies a few numbers, relative to a plain thread."""

Op = Callable[..., tuple[Tensor, ...]]
"""``op(ctx, *tensors) -> tensors`` with an ``OpContext``."""

_CORES = os.cpu_count() or 1
_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()


def _workers() -> ThreadPoolExecutor:
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max_workers=_CORES, thread_name_prefix="warpgs")
        return _pool


class OpContext:
    """One call of an op: its forward pass, and its backward pass if there is one.

    Args:
        device: Device of all tensors.
        inputs_with_gradient: Those inputs of the op that need a gradient.

    Attributes:
        device: Device of all tensors.
        needs_backward: Whether there may be a backward pass; if not, ops save nothing for it.
        is_cuda: Whether the device is a GPU.
        num_shards: Number of cores that a CPU launch uses (``torch.get_num_threads()``); 1 on CUDA.
        outputs_written_in_backward: Outputs of the op that the backward pass fills.
        read_in_backward: Tensors that the backward pass reads; those that are outputs of the op must not be modified
            before.
        replay_conditions: Must all be true for the recorded launches to be valid for other values of the inputs.
    """

    def __init__(self, device: torch.device, inputs_with_gradient: Sequence[Tensor]):
        self.device = device
        self.needs_backward = bool(inputs_with_gradient)
        self._inputs_with_gradient = {id(t) for t in inputs_with_gradient}
        self.is_cuda = device.type == "cuda"
        self.num_shards = 1 if self.is_cuda else max(1, min(torch.get_num_threads(), _CORES))
        self._warp_device = wp.device_from_torch(device)
        self.stream = self._current_stream()
        self.outputs_written_in_backward: list[Tensor] = []
        self.read_in_backward: list[Tensor] = []
        self.replay_conditions: list[Callable[[], bool]] = []
        self._tape = wp.Tape()
        self._gradients: dict[int, Tensor | None] = {}
        self._gradient_owners: list[Tensor] = []

    def empty(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """An uninitialised tensor on the device."""
        return torch.empty(shape, dtype=dtype, device=self.device)

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """A tensor of zeros on the device."""
        return torch.zeros(shape, dtype=dtype, device=self.device)

    def needs_gradient(self, tensor: Tensor) -> bool:
        """Whether this input of the op needs a gradient."""
        return id(tensor) in self._inputs_with_gradient

    # Backward pass ----------------------------------------------------------------------------------------------------

    def on_backward(self, function: Callable[["OpContext"], None], reads: Sequence[Tensor] = ()) -> None:
        """Records the backward pass of the last launches; recorded functions are called in reverse order.

        Args:
            function: Called with this context. It must not hold the context itself: the context holds the function,
                and a reference cycle would keep the memory of a whole render until garbage collection.
            reads: Tensors that it reads and that may be outputs of the op.
        """
        if self.needs_backward:
            self.read_in_backward += reads
            this = weakref.proxy(self)
            self._tape.record_func(lambda: function(this), [])

    def gradient(self, tensor: Tensor) -> Tensor | None:
        """The gradient of a tensor so far in the backward pass, contiguous; None if there is none."""
        value = self._gradients.get(id(tensor))
        return None if value is None else value.contiguous()

    def add_gradient(self, tensor: Tensor, value: Tensor) -> None:
        """Adds to the gradient of a tensor."""
        known = self._gradients.get(id(tensor))
        self._gradients[id(tensor)] = value if known is None else known + value
        self._gradient_owners.append(tensor)  # so that its id is not reused

    def backward(self, outputs: Sequence[Tensor], gradients: Sequence[Tensor | None]) -> None:
        """Runs the recorded backward pass from the gradients of the op's outputs."""
        self.stream = self._current_stream()
        self._gradients = {id(o): g for o, g in zip(outputs, gradients, strict=True)}
        self._tape.backward()

    def clear_gradients(self) -> None:
        """Frees the gradients of a backward pass, which may be repeated (``retain_graph``)."""
        self._gradients = {}
        self._gradient_owners = []

    # Launching --------------------------------------------------------------------------------------------------------

    def launch(self, kernel: wp.Kernel, dim: int, *arguments: Any, block_dim: int = 256, work: int | float = 1) -> None:
        """Launches ``dim`` threads of a kernel.

        Args:
            kernel: Its first parameter is ``first``.
            dim: Number of threads.
            arguments: Of the parameters after ``first``.
            block_dim: Threads per CUDA block.
            work: Work of one of its threads relative to a plain thread, to decide how many cores a CPU launch uses.
        """
        if dim == 0:
            return
        with profiling.span(kernel.func.__name__, self.device):
            self._launch(kernel, dim, arguments, block_dim, work)

    def launch_adjoint(
        self, kernel: wp.Kernel, dim: int, tensors: Sequence[Tensor], gradients: Sequence[Tensor]
    ) -> None:
        """Launches the adjoint kernel that Warp generated for a kernel: adds to the gradients of the kernel's inputs.

        ``tensors`` and ``gradients`` are those of the kernel's parameters after ``first``.
        """

        def arrays(values: Sequence[Tensor]) -> list[wp.array]:
            types = [argument.type.dtype for argument in kernel.adj.args[1:]]
            return [wp.from_torch(t.detach(), d, requires_grad=False) for t, d in zip(values, types, strict=True)]

        wp.launch(
            kernel,
            dim=dim,
            inputs=[0, *arrays(tensors)],
            adj_inputs=[0, *arrays(gradients)],
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
        """torch's current stream as a Warp stream; None on CPU."""
        if not self.is_cuda:
            return None
        handle = torch.cuda.current_stream(self.device).cuda_stream
        stream = _streams.get((self.device.index, handle))
        if stream is None:
            stream = _streams[self.device.index, handle] = wp.Stream(self._warp_device, cuda_stream=handle)
        return stream

    def sort_pairs(self, keys: Tensor, values: Tensor, count: int, num_bits: int) -> None:
        """Sorts the first ``count`` int32 pairs by the low bits of the keys, stably; buffers hold twice that many."""
        device = self._warp_device
        pairs = (_int_array(t.data_ptr(), t.numel(), device.alias) for t in (keys, values))
        with profiling.span("sort_pairs", self.device):
            if not self.is_cuda:
                wp.utils.radix_sort_pairs(*pairs, count, 0, num_bits)
                return
            # Warp sorts on its current stream. No event is waited for, because a CUDA graph capture forbids that.
            # During a capture the lock is already held, possibly by a thread that waits for this one.
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
    """A Warp array over memory of torch; cached, because torch's allocator reuses the same blocks."""
    return wp.array(ptr=pointer, dtype=wp.int32, shape=(size,), device=device)


def indices(subset: Sequence[Tensor], tensors: Sequence[Tensor]) -> list[int]:
    """Indices of those ``tensors`` that are in ``subset``."""
    return [k for k, tensor in enumerate(tensors) if any(tensor is s for s in subset)]


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, op: Op, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        device = next(t.device for t in tensors if t is not None)
        ctx.context = OpContext(device, [t for t in tensors if t is not None and t.requires_grad])
        ctx.set_materialize_grads(False)
        ctx.raw_inputs = tensors
        ctx.raw_outputs = op(ctx.context, *tensors)
        # Aliases of the outputs are returned, because the context holds the originals and would otherwise keep its own
        # graph alive. Saving what the backward pass reads lets torch detect that it was modified in place.
        outputs = tuple(o.detach() for o in ctx.raw_outputs)
        ctx.save_for_backward(*tensors, *(outputs[k] for k in indices(ctx.context.read_in_backward, ctx.raw_outputs)))
        ctx.mark_non_differentiable(*(o for o in outputs if not o.is_floating_point()))
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        with torch.no_grad():
            ctx.context.backward(ctx.raw_outputs, gradients)
            v_inputs = [None if t is None else ctx.context.gradient(t) for t in ctx.raw_inputs]
            ctx.context.clear_gradients()
            return None, *(v if n else None for v, n in zip(v_inputs, ctx.needs_input_grad[1:], strict=True))


def differentiable(op: Op, *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """Calls ``op(ctx, *tensors)``, as a node of autograd if an input requires a gradient.

    Args:
        op: Returns a tuple of tensors; those of integer type have no gradient.
        tensors: Its inputs, contiguous and all on one device; None is passed on.
    """
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors):
        return _Differentiable.apply(op, *tensors)
    device = next(t.device for t in tensors if t is not None)
    with torch.no_grad():
        return op(OpContext(device, []), *tensors)


def launch_with_generated_adjoint(
    ctx: OpContext, kernel: wp.Kernel, dim: int, inputs: Sequence[Tensor], outputs: Sequence[Tensor]
) -> None:
    """Launches a kernel and records the adjoint kernel that Warp generated for it.

    ``inputs`` and ``outputs`` are float tensors, in the order of the kernel's parameters after ``first``.
    """
    ctx.launch(kernel, dim, *inputs, *outputs)

    def backward(ctx: OpContext) -> None:
        v_inputs = [torch.zeros_like(t) for t in inputs]
        v_outputs = [torch.zeros_like(t) if (v := ctx.gradient(t)) is None else v for t in outputs]
        if dim > 0:
            ctx.launch_adjoint(kernel, dim, [*inputs, *outputs], [*v_inputs, *v_outputs])
        for tensor, value in zip(inputs, v_inputs, strict=True):
            ctx.add_gradient(tensor, value)

    ctx.on_backward(backward)


def pinned_counter(device: torch.device) -> Tensor:
    """One int64 in host memory that a kernel on ``device`` can write to, initially zero."""
    counter = torch.zeros(1, dtype=torch.int64)
    return counter.pin_memory() if device.type == "cuda" else counter
