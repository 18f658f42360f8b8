"""Results of networks for all frames of a camera, one by one."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

Read = Callable[[Path, Sequence[str], Sequence[tuple[int, int]]], Iterator[Shaped[np.ndarray, "H W"]]]
"""Reads results from a path, of frames with these ids, and widths and heights."""


def checked(
    read: Read, path: Path, names: Sequence[str], sizes: Sequence[tuple[int, int]]
) -> Iterator[Shaped[np.ndarray, "H W"]]:
    """Results that are read twice: all are valid before the first is given, and one is in memory at a time.

    Raises:
        ValueError: As ``read``, at once.
    """
    for _ in read(path, names, sizes):
        pass
    return read(path, names, sizes)
