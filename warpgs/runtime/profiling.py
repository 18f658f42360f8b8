"""Kernel times: CUDA events on a GPU, wall time on CPU."""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch


@dataclass
class KernelTime:
    """One launch: start since the begin of the profile and duration [ms]."""

    name: str
    start_ms: float
    duration_ms: float


@dataclass
class Profile:
    """The launches inside ``profile``."""

    _origin: float = field(default_factory=time.perf_counter)
    _first_event: Any = None
    _entries: list[tuple[str, Any, Any]] = field(default_factory=list)

    def times(self) -> list[KernelTime]:
        """One entry per launch, in order; waits for the device."""
        if self._first_event is not None:
            torch.cuda.synchronize()
        result = []
        for name, begin, end in self._entries:
            if isinstance(begin, float):
                result.append(KernelTime(name, (begin - self._origin) * 1e3, (end - begin) * 1e3))
            else:
                result.append(KernelTime(name, self._first_event.elapsed_time(begin), begin.elapsed_time(end)))
        return result

    @contextlib.contextmanager
    def span(self, name: str, device: torch.device) -> Iterator[None]:
        """Times the body of a ``with`` statement as one entry."""
        if device.type == "cuda":
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            self._first_event = self._first_event or begin
            yield
            end.record()
            self._entries.append((name, begin, end))
        else:
            start = time.perf_counter()
            yield
            self._entries.append((name, start, time.perf_counter()))


_active_profile: Profile | None = None
_NOTHING = contextlib.nullcontext()


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


def span(name: str, device: torch.device) -> contextlib.AbstractContextManager[None]:
    """Times the body of a ``with`` statement if a profile is active."""
    return _NOTHING if _active_profile is None else _active_profile.span(name, device)
