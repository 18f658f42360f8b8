"""Kernel times: CUDA events on a GPU, wall time on CPU."""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor


@dataclass
class KernelTime:
    """One launch: start since the first launch of the profile and duration [ms]."""

    name: str
    start_ms: float
    duration_ms: float


@dataclass
class Profile:
    """The launches inside ``profile``."""

    _entries: list[tuple[str, Any, Any]] = field(default_factory=list)

    def times(self) -> list[KernelTime]:
        """One entry per launch, in order; waits for the device."""
        if self._entries and not isinstance(self._entries[0][1], float):
            torch.cuda.synchronize()
        return [KernelTime(n, _milliseconds(self._entries[0][1], a), _milliseconds(a, b)) for n, a, b in self._entries]


def _now(tensor: Tensor) -> Any:
    """A CUDA event on the current stream, or the time on CPU."""
    if not tensor.is_cuda:
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def _milliseconds(begin: Any, end: Any) -> float:
    return (end - begin) * 1e3 if isinstance(begin, float) else begin.elapsed_time(end)


_active_profile: Profile | None = None


@contextlib.contextmanager
def profile() -> Iterator[Profile]:
    """Times every kernel that is launched inside: CUDA events on a GPU, wall time on CPU.

    Raises:
        RuntimeError: If another profile is active.
    """
    global _active_profile
    if _active_profile is not None:
        raise RuntimeError("another profile is active")
    _active_profile = Profile()
    try:
        yield _active_profile
    finally:
        _active_profile = None


def is_on() -> bool:
    """Whether a profile is active."""
    return _active_profile is not None


def begin(tensor: Tensor) -> Any:
    """The time now on the device of a tensor, for ``end``; None unless a profile is active."""
    return None if _active_profile is None else _now(tensor)


def end(name: str, begun: Any, tensor: Tensor) -> None:
    """Adds an entry from the time of ``begin`` until now, if a profile was active then and is now."""
    if _active_profile is not None and begun is not None:
        _active_profile._entries.append((name, begun, _now(tensor)))


@contextlib.contextmanager
def span(name: str, tensor: Tensor) -> Iterator[None]:
    """Times the body of a ``with`` statement if a profile is active."""
    begun = begin(tensor)
    yield
    end(name, begun, tensor)
