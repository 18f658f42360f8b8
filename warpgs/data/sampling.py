"""Samples of a sequence; needs no torch."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def evenly_spaced_indices(count: int, max_count: int) -> list[int]:
    """At most ``max_count`` indices below ``count``, evenly spaced from the first to the last; a single one is 0."""
    return np.unique(np.linspace(0, count - 1, min(count, max_count)).round().astype(int)).tolist()


def evenly_spaced(items: Sequence[Item], max_count: int) -> list[Item]:
    """At most ``max_count`` items, evenly spaced from the first to the last."""
    return [items[k] for k in evenly_spaced_indices(len(items), max_count)]
