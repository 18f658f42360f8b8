"""The resident memory of a process over time."""

import os
from pathlib import Path

import pytest

MAX_GROWTH = 8 << 20
"""Bytes by which resident memory may grow after the first third."""

needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="needs /proc")


def resident(process: int | str = "self") -> int:
    """Resident memory of a process, by default this one [bytes]."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def growth(sizes: list[int]) -> int:
    """How much the maximum of the last third is above that of the second; in the first, memory settles."""
    settled = sizes[len(sizes) // 3 :]
    return max(settled[len(settled) // 2 :]) - max(settled[: len(settled) // 2])


def in_mebibytes(sizes: list[int], number: int = 60) -> str:
    """Evenly spread ones of some sizes, for people."""
    return str([size >> 20 for size in sizes[:: -(-len(sizes) // number)]])
