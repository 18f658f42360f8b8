"""Samples of a sequence; needs no torch."""

import numpy as np


def evenly_spaced_indices(count: int, max_count: int) -> list[int]:
    """At most ``max_count`` indices below ``count``, evenly spaced from the first to the last; a single one is 0."""
    return np.unique(np.linspace(0, count - 1, min(count, max_count)).round().astype(int)).tolist()
