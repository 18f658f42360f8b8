"""Measures times on the clock of the device."""

import time
from collections.abc import Callable

import torch


def milliseconds(step: Callable[[], object], device: str) -> float:
    """Duration of a step [ms]: by CUDA events on a GPU, by the wall clock on CPU."""
    if device == "cpu":
        start = time.perf_counter()
        step()
        return (time.perf_counter() - start) * 1e3
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    step()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end)
