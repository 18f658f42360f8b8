"""Work that repeats, replayed from CUDA graphs.

The kernels of a small render take a GPU less time than the host needs to launch them one by one. What has been called a
few times with inputs of the same shapes is therefore recorded, the way forth and the way back, and from then on takes
one launch each way. Results are the same: inputs are copied to where the recording reads them, outputs and gradients
are copied out of it, and a recording whose way back may still be gone is not used for another call.

To record is to wait for the GPU, and CUDA forbids every thread to wait for the whole of it meanwhile. So only the main
thread records and replays; other threads call plainly.
"""

import atexit
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

from . import profiling
from .graphs import record
from .streams import PRIORITY
from .tape import Op, Run, differentiable, indices

CPU = torch.device("cpu")

PLAIN_CALLS = 8
"""Calls of one kind before one is recorded. They load kernels, find out how many intersections to expect, and show that
the calls do repeat: recording takes as long as some of them."""

MAX_VALUE = 1 << 25
"""Bytes of inputs and outputs above which nothing is replayed: launching is not what takes time there, copying is."""

MAX_KEYS = 16
"""Kinds of calls that are remembered."""

MAX_RECORDINGS = 4
"""Of all kinds together: so many renders may wait for their ways back at a time."""

MAX_BACKWARDS = 4
"""Sets of outputs that cotangents arrive at, of one recording; the way back from others is gone plainly."""


class _Buffers:
    """Tensors that stay where they are, for a graph to read or write, with None for those that there are not.

    Those of elements of four bytes are copied in one launch, bit by bit.
    """

    def __init__(self, tensors: Sequence[Tensor | None]) -> None:
        self.tensors: list[Any] = list(tensors)
        given = [(k, t) for k, t in enumerate(tensors) if t is not None]
        self._words = [(k, t.is_floating_point()) for k, t in given if t.element_size() == 4]
        self._others = [k for k, t in given if t.element_size() != 4]
        self._own_words = [t.detach() for t in self._as_floats(tensors)]

    def fill(self, sources: Sequence[Any]) -> None:
        """Copies tensors of the same shapes into these."""
        if self._words:
            torch._foreach_copy_(self._own_words, self._as_floats(sources))
        for k in self._others:
            self.tensors[k].copy_(sources[k])

    def copies(self) -> list[Any]:
        """New tensors with what these hold."""
        copies: list[Any] = [None if t is None else torch.empty_like(t) for t in self.tensors]
        if self._words:
            torch._foreach_copy_(self._as_floats(copies), self._own_words)
        for k in self._others:
            copies[k].copy_(self.tensors[k])
        return copies

    def _as_floats(self, tensors: Sequence[Any]) -> list[Tensor]:
        """Those of elements of four bytes, whatever these are."""
        return [tensors[k] if is_float else tensors[k].view(torch.float32) for k, is_float in self._words]


class _WayBack:
    """A recorded way back, with the cotangents that it starts from and the gradients that it leaves."""

    def __init__(self, recording: "Recording", cotangents: Sequence[Tensor | None]) -> None:
        own = [None if c is None else torch.empty_like(c, memory_format=torch.contiguous_format) for c in cotangents]
        self._cotangents = _Buffers(own)

        def work() -> None:
            self._gradients = _Buffers(recording.go_back(own))

        self._replay = recording.record(work)

    def __call__(self, cotangents: Sequence[Tensor | None]) -> list[Tensor | None]:
        self._cotangents.fill(cotangents)
        self._replay()
        return self._gradients.copies()


class Recording:
    """An op, recorded with tensors of its own.

    Args:
        op: As for ``differentiable``; what it reads besides its tensors must never change.
        tensors: Inputs like those that are to come.
        wants: Whether gradients will be asked for, of the tensors that want them.

    Attributes:
        filled: Indices of the outputs that the way back writes to.
        read: Indices of the outputs that it reads.
    """

    def __init__(self, op: Op, tensors: Sequence[Tensor | None], wants: bool) -> None:
        self._inputs = _Buffers(
            [None if t is None else t.detach().clone().requires_grad_(wants and t.requires_grad) for t in tensors]
        )
        self._device = next(t.device for t in tensors if t is not None)
        self._stream_and_pool = _stream_and_pool(self._device)
        self._ways_back: dict[tuple[bool, ...], _WayBack | None] = {}
        self._replay = self.record(lambda: self._go(op))

    def is_valid(self) -> bool:
        """Whether what was assumed when it was recorded still holds."""
        return all(condition() for condition in self._run.conditions)

    def launch(self, tensors: Sequence[Tensor | None]) -> None:
        """Sets off with other inputs."""
        self._inputs.fill(tensors)
        self._replay()

    def outputs(self) -> list[Tensor]:
        """What came out of the last ``launch``."""
        return self._outputs.copies()

    def backward(self, cotangents: Sequence[Tensor | None], filled: Sequence[Tensor]) -> list[Tensor | None]:
        """Gradients of the inputs of the last ``launch``; writes to those of its outputs that ``self.filled`` says."""
        arrived = tuple([c is not None for c in cotangents])
        way = self._ways_back.get(arrived)
        if way is None and arrived in self._ways_back:
            way = self._ways_back[arrived] = _WayBack(self, cotangents)
        if way is not None:
            gradients = way(cotangents)
        else:
            # The first time plainly: it loads kernels, which a capture could not.
            gradients = self.go_back(cotangents)
            if len(self._ways_back) < MAX_BACKWARDS:
                self._ways_back[arrived] = None
        for output, k in zip(filled, self.filled, strict=True):
            output.copy_(self._outputs.tensors[k])
        return gradients

    def record(self, work: Callable[[], None]) -> Callable[[], None]:
        return record(work, *self._stream_and_pool)

    def _go(self, op: Op) -> None:
        inputs = self._inputs.tensors
        self._run = Run(self._device, [t for t in inputs if t is not None and t.requires_grad])
        with torch.no_grad():
            outputs = op(self._run, *inputs)
        self._outputs = _Buffers(outputs)
        self.filled, self.read = (indices(some, outputs) for some in (self._run.filled, self._run.read))

    def go_back(self, cotangents: Sequence[Tensor | None]) -> list[Tensor | None]:
        """The way back itself."""
        self._run.backward(self._outputs.tensors, cotangents)
        inputs = self._inputs.tensors
        gradients = [self._run.adjoint(t) if t is not None and t.requires_grad else None for t in inputs]
        self._run.forget_adjoints()
        return gradients


def _stream_and_pool(device: torch.device) -> tuple[torch.cuda.Stream, Any]:
    """What all graphs of a recording share, for ``record``."""
    return torch.cuda.Stream(device, priority=PRIORITY), torch.cuda.graph_pool_handle()


# ---------------------------------------------------------------------------------------------------------------------
# Which recording a call takes


class _Lease:
    """A recording in use, until nobody can go its way back any more."""

    def __init__(self, kind: "_Kind", recording: Recording) -> None:
        self._kind, self.recording = kind, recording

    def __del__(self) -> None:
        self._kind.idle.append(self.recording)


class _Kind:
    """Calls that are alike.

    Attributes:
        calls: How many there have been without a recording.
        bytes: Of inputs and outputs.
        idle: Recordings that are not in use.
        recordings: How many there are.
    """

    def __init__(self) -> None:
        self.calls = self.bytes = self.recordings = 0
        self.idle: list[Recording] = []

    def lease(self, op: Op, tensors: Sequence[Tensor | None], wants: bool) -> _Lease | None:
        """A recording for this call, if there is one or it is time to make one."""
        if self.calls < PLAIN_CALLS or self.bytes > MAX_VALUE:
            return None
        if self.idle:
            recording = self.idle.pop()
            if recording.is_valid():
                return _Lease(self, recording)
            self.recordings -= 1
            self.calls = 0
            return None
        if not _make_room():
            return None
        lease = _Lease(self, Recording(op, tensors, wants))
        self.recordings += 1
        return lease


_kinds: dict[Hashable, _Kind] = {}
"""By key, the least recently called first."""

atexit.register(_kinds.clear)  # graphs go before CUDA does


def _kind(key: Hashable) -> _Kind:
    kind = _kinds.pop(key, None) or _Kind()
    if len(_kinds) == MAX_KEYS:
        del _kinds[next(iter(_kinds))]
    _kinds[key] = kind
    return kind


def _make_room() -> bool:
    """Whether another recording may be made; drops one of the least recent kind that has one to spare."""
    if sum(kind.recordings for kind in _kinds.values()) < MAX_RECORDINGS:
        return True
    for kind in _kinds.values():
        if kind.idle:
            kind.idle.pop()
            kind.recordings -= 1
            return True
    return False


class _Replayed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lease: _Lease, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.lease = lease
        outputs = lease.recording.outputs()
        # The recording has copies; but where a plain call could not be gone back from, this one cannot either.
        ctx.save_for_backward(*tensors, *[outputs[k] for k in lease.recording.read])
        ctx.filled = [outputs[k].detach() for k in lease.recording.filled]  # without their graph, which holds this
        ctx.mark_non_differentiable(*[o for o in outputs if not o.is_floating_point()])
        return tuple(outputs)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        with torch.set_grad_enabled(False):  # which is quicker than no_grad
            return None, *ctx.lease.recording.backward(cotangents, ctx.filled)


def _stream(device: torch.device) -> int:
    """A number for torch's current stream; to ask so is quicker than to have a ``torch.cuda.Stream`` made."""
    return torch.accelerator.current_stream(device.index).stream_id


def _can_replay(device: torch.device) -> bool:
    return (
        device != CPU  # device.type would be a string made anew
        and threading.current_thread() is threading.main_thread()
        and not profiling.is_on()
        and not torch.is_inference_mode_enabled()
        and not torch.cuda.is_current_stream_capturing()
    )


def repeated(key: Hashable, op: Op, *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """As ``differentiable``; on CUDA calls that are alike and not large are replayed after a few.

    Args:
        key: What ``op`` reads besides its tensors: calls with equal keys do the same with the same inputs.
        op: As for ``differentiable``. Float outputs may be filled on the way back if the run knows (``Run.filled``).
        tensors: Its inputs, all of them: it must not read others.
    """
    device = next(t.device for t in tensors if t is not None)
    if not _can_replay(device):
        return differentiable(op, *tensors)
    wants = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
    shapes = tuple([None if t is None else (t.shape, t.dtype, wants and t.requires_grad) for t in tensors])
    kind = _kind((key, device, _stream(device), shapes))
    lease = kind.lease(op, tensors, wants)
    if lease is None:
        outputs = differentiable(op, *tensors)
        kind.calls += 1
        kind.bytes = sum(t.numel() * t.element_size() for t in (*tensors, *outputs) if t is not None)
        return outputs
    # The GPU has nothing to do until here, and enough while autograd takes its time.
    with torch.set_grad_enabled(False):
        lease.recording.launch(tensors)
    return _Replayed.apply(lease, *tensors) if wants else tuple(lease.recording.outputs())
