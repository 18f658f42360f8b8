"""Automatic replay of repeated op calls from CUDA graphs.

The kernels of a small render take a GPU less time than the host needs to launch them one by one. An op that has been
called a few times with inputs of the same shapes is therefore recorded, forward and backward, and from then on takes
one launch for each pass. Results are the same: inputs are copied to the tensors of the recording, outputs and gradients
are copied from them, and a recording whose backward pass may still run is not used for another call.

Recording waits for the GPU, and during a capture CUDA forbids every thread to wait for the whole GPU. So only the main
thread records and replays; other threads call the op eagerly.
"""

import atexit
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import profiling
from .graphs import record
from .streams import PRIORITY
from .tape import Op, OpContext, differentiable, indices

CPU = torch.device("cpu")

EAGER_CALLS = 8
"""Eager calls with one signature before one is recorded. They load kernels, learn the number of intersections and show
that the call is repeated: recording takes as long as several calls."""

MAX_BYTES = 1 << 25
"""Calls with more bytes of inputs and outputs are not replayed: copying them would take longer than launching."""

MAX_SIGNATURES = 16
"""Number of signatures whose calls are counted."""

MAX_RECORDINGS = 4
"""Maximum number of recordings of all signatures, and so of replayed calls whose backward pass is pending."""

MAX_BACKWARD_GRAPHS = 4
"""Maximum number of backward graphs of a recording, one for each set of outputs with a gradient; others run eagerly."""


class _Buffers:
    """Tensors at fixed addresses that a graph reads or writes; missing ones are None.

    All tensors with elements of four bytes are copied in one launch, bit by bit.
    """

    def __init__(self, tensors: Sequence[Tensor | None]) -> None:
        self.tensors: list[Any] = list(tensors)
        given = [(k, t) for k, t in enumerate(tensors) if t is not None]
        self._words = [(k, t.is_floating_point()) for k, t in given if t.element_size() == 4]
        self._others = [k for k, t in given if t.element_size() != 4]
        self._own_words = [t.detach() for t in self._as_floats(tensors)]

    def fill(self, sources: Sequence[Any]) -> None:
        """Copies tensors of the same shapes to these."""
        if self._words:
            torch._foreach_copy_(self._own_words, self._as_floats(sources))
        for k in self._others:
            self.tensors[k].copy_(sources[k])

    def copies(self) -> list[Any]:
        """New tensors with the values of these."""
        copies: list[Any] = [None if t is None else torch.empty_like(t) for t in self.tensors]
        if self._words:
            torch._foreach_copy_(self._as_floats(copies), self._own_words)
        for k in self._others:
            copies[k].copy_(self.tensors[k])
        return copies

    def _as_floats(self, tensors: Sequence[Any]) -> list[Tensor]:
        """The tensors with elements of four bytes, viewed as floats."""
        return [tensors[k] if is_float else tensors[k].view(torch.float32) for k, is_float in self._words]


class _BackwardGraph:
    """A recorded backward pass from gradients of the outputs to gradients of the inputs."""

    def __init__(self, recording: "Recording", v_outputs: Sequence[Tensor | None]) -> None:
        own = [None if v is None else torch.empty_like(v, memory_format=torch.contiguous_format) for v in v_outputs]
        self._v_outputs = _Buffers(own)

        def work() -> None:
            self._v_inputs = _Buffers(recording.run_backward(own))

        self._replay = recording.record(work)

    def __call__(self, v_outputs: Sequence[Tensor | None]) -> list[Tensor | None]:
        self._v_outputs.fill(v_outputs)
        self._replay()
        return self._v_inputs.copies()


class Recording:
    """An op, recorded with its own copies of the inputs and outputs.

    Args:
        op: As for ``differentiable``; everything else that it reads must never change.
        tensors: Inputs of the shapes of all later calls.
        needs_backward: Whether there may be a backward pass to those inputs that require a gradient.

    Attributes:
        written_in_backward: Indices of the outputs that the backward pass fills.
        read_in_backward: Indices of the outputs that it reads.
    """

    def __init__(self, op: Op, tensors: Sequence[Tensor | None], needs_backward: bool) -> None:
        copies = [None if t is None else t.detach().clone() for t in tensors]
        for copy, tensor in zip(copies, tensors, strict=True):
            if copy is not None and tensor is not None:
                copy.requires_grad_(needs_backward and tensor.requires_grad)
        self._inputs = _Buffers(copies)
        self._device = next(t.device for t in tensors if t is not None)
        self._stream_and_pool = _stream_and_pool(self._device)
        self._backward_graphs: dict[tuple[bool, ...], _BackwardGraph | None] = {}
        self._replay = self.record(lambda: self._run_forward(op))

    def is_valid(self) -> bool:
        """Whether the assumptions made when it was recorded still hold."""
        return all(condition() for condition in self._ctx.replay_conditions)

    def launch(self, tensors: Sequence[Tensor | None]) -> None:
        """Replays the forward pass with new values of the inputs."""
        self._inputs.fill(tensors)
        self._replay()

    def outputs(self) -> list[Tensor]:
        """The outputs of the last ``launch``."""
        return self._outputs.copies()

    def backward(self, v_outputs: Sequence[Tensor | None], written: Sequence[Tensor]) -> list[Tensor | None]:
        """Gradients of the inputs of the last ``launch``, from those of its outputs.

        Also fills ``written``, the caller's outputs at the indices ``written_in_backward``.
        """
        key = tuple([v is not None for v in v_outputs])
        graph = self._backward_graphs.get(key)
        if graph is None and key in self._backward_graphs:
            graph = self._backward_graphs[key] = _BackwardGraph(self, v_outputs)
        if graph is not None:
            gradients = graph(v_outputs)
        else:
            # The first time eagerly, because it loads kernels, which is impossible during a capture.
            gradients = self.run_backward(v_outputs)
            if len(self._backward_graphs) < MAX_BACKWARD_GRAPHS:
                self._backward_graphs[key] = None
        for output, k in zip(written, self.written_in_backward, strict=True):
            output.copy_(self._outputs.tensors[k])
        return gradients

    def record(self, work: Callable[[], None]) -> Callable[[], None]:
        """Records ``work`` in a graph that shares its memory with the other graphs of this recording."""
        return record(work, *self._stream_and_pool)

    def _run_forward(self, op: Op) -> None:
        inputs = self._inputs.tensors
        self._ctx = OpContext(self._device, [t for t in inputs if t is not None and t.requires_grad])
        with torch.no_grad():
            outputs = op(self._ctx, *inputs)
        self._outputs = _Buffers(outputs)
        self.written_in_backward = indices(self._ctx.outputs_written_in_backward, outputs)
        self.read_in_backward = indices(self._ctx.read_in_backward, outputs)

    def run_backward(self, v_outputs: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Launches the backward pass; returns gradients of the inputs."""
        self._ctx.backward(self._outputs.tensors, v_outputs)
        inputs = self._inputs.tensors
        gradients = [self._ctx.gradient(t) if t is not None and t.requires_grad else None for t in inputs]
        self._ctx.clear_gradients()
        return gradients


def _stream_and_pool(device: torch.device) -> tuple[torch.cuda.Stream, Any]:
    """The stream and the memory pool that all graphs of a recording share."""
    return torch.cuda.Stream(device, priority=PRIORITY), torch.cuda.graph_pool_handle()


# ---------------------------------------------------------------------------------------------------------------------
# Choosing the recording for a call


class _Lease:
    """A recording in use, as long as its backward pass may run."""

    def __init__(self, signature: "_Signature", recording: Recording) -> None:
        self._signature, self.recording = signature, recording

    def __del__(self) -> None:
        self._signature.idle.append(self.recording)


class _Signature:
    """The calls with one signature: op, device, stream, shapes and types of the inputs.

    Attributes:
        calls: Number of eager calls since there was a valid recording.
        bytes: Size of inputs and outputs.
        idle: Recordings that are not in use.
        recordings: Number of recordings.
    """

    def __init__(self) -> None:
        self.calls = self.bytes = self.recordings = 0
        self.idle: list[Recording] = []

    def lease(self, op: Op, tensors: Sequence[Tensor | None], needs_backward: bool) -> _Lease | None:
        """A recording for this call, if there is one or after enough eager calls; None otherwise."""
        if self.calls < EAGER_CALLS or self.bytes > MAX_BYTES:
            return None
        if self.idle:
            recording = self.idle.pop()
            if recording.is_valid():
                return _Lease(self, recording)
            self.recordings -= 1
            self.calls = 0
            return None
        if not _can_add_recording():
            return None
        lease = _Lease(self, Recording(op, tensors, needs_backward))
        self.recordings += 1
        return lease


_signatures: dict[Hashable, _Signature] = {}
"""By key, the least recently called first."""

atexit.register(_signatures.clear)  # frees the graphs before CUDA shuts down


def _signature(key: Hashable) -> _Signature:
    signature = _signatures.pop(key, None) or _Signature()
    if len(_signatures) == MAX_SIGNATURES:
        del _signatures[next(iter(_signatures))]
    _signatures[key] = signature
    return signature


def _can_add_recording() -> bool:
    """Whether another recording may be made; if necessary, drops an idle one of the least recent signature."""
    if sum(signature.recordings for signature in _signatures.values()) < MAX_RECORDINGS:
        return True
    for signature in _signatures.values():
        if signature.idle:
            signature.idle.pop()
            signature.recordings -= 1
            return True
    return False


class _Replayed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lease: _Lease, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.lease = lease
        outputs = lease.recording.outputs()
        # The recording has copies of these; saving them makes in-place changes an error, as for an eager call.
        ctx.save_for_backward(*tensors, *[outputs[k] for k in lease.recording.read_in_backward])
        # Without their graph, which holds this context.
        ctx.written = [outputs[k].detach() for k in lease.recording.written_in_backward]
        ctx.mark_non_differentiable(*[o for o in outputs if not o.is_floating_point()])
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        with torch.set_grad_enabled(False):  # faster than no_grad
            return None, *ctx.lease.recording.backward(v_outputs, ctx.written)


def _stream(device: torch.device) -> int:
    """The id of torch's current stream; faster than creating a ``torch.cuda.Stream``."""
    return torch.accelerator.current_stream(device.index).stream_id


def _can_replay(device: torch.device) -> bool:
    return (
        device != CPU  # faster than comparing device.type, which creates a string
        and threading.current_thread() is threading.main_thread()
        and not profiling.is_on()
        and not torch.is_inference_mode_enabled()
        and not torch.cuda.is_current_stream_capturing()
    )


def differentiable_with_replay(key: Hashable, op: Op, *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """As ``differentiable``; on CUDA, small calls that are repeated are replayed from CUDA graphs.

    Args:
        key: Everything that ``op`` reads except its tensors: calls with equal keys have equal results for equal inputs.
        op: As for ``differentiable``. Outputs that its backward pass fills must be registered in
            ``OpContext.outputs_written_in_backward``.
        tensors: All of its inputs; it must not read other tensors.
    """
    device = next(t.device for t in tensors if t is not None)
    if not _can_replay(device):
        return differentiable(op, *tensors)
    needs_backward = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
    shapes = tuple([None if t is None else (t.shape, t.dtype, needs_backward and t.requires_grad) for t in tensors])
    signature = _signature((key, device, _stream(device), shapes))
    lease = signature.lease(op, tensors, needs_backward)
    if lease is None:
        outputs = differentiable(op, *tensors)
        signature.calls += 1
        signature.bytes = sum(t.numel() * t.element_size() for t in (*tensors, *outputs) if t is not None)
        return outputs
    # Launched before autograd's bookkeeping, so that the GPU has work meanwhile.
    with torch.set_grad_enabled(False):
        lease.recording.launch(tensors)
    return _Replayed.apply(lease, *tensors) if needs_backward else tuple(lease.recording.outputs())
