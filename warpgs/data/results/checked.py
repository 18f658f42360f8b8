"""Results of networks for all frames of a camera, one by one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

Size = tuple[int, int]
"""Width and height of a frame."""


@dataclass(frozen=True)
class Results:
    """Results of frames, each of which is made anew whenever they are iterated over.

    Attributes:
        sources: What each is made of: its file, or its part of the file of all, which is read once.
        sizes: Width and height of each frame.
        make: Makes one of its source; raises ``ValueError`` if that is damaged or of another shape.
    """

    sources: Sequence[Any]
    sizes: Sequence[Size]
    make: Callable[[Any, Size], np.ndarray]

    def __iter__(self) -> Iterator[Shaped[np.ndarray, "H W"]]:
        return (self.make(source, size) for source, size in zip(self.sources, self.sizes, strict=True))


Read = Callable[[Path, Sequence[str], Sequence[Size]], Results]
"""Reads results from a path, of frames with these ids and sizes."""


def checked(read: Read, path: Path, names: Sequence[str], sizes: Sequence[Size]) -> Iterator[Shaped[np.ndarray, "H W"]]:
    """Results that are made twice: all are valid before the first is given, and one is in memory at a time.

    Raises:
        ValueError: As ``read`` and its results, at once.
    """
    found = read(path, names, sizes)
    for _ in found:
        pass
    return iter(found)
