"""Evenly spaced samples."""

import pytest

from warpgs.data.sampling import evenly_spaced_indices


@pytest.mark.parametrize(
    ("count", "max_count", "expected"),
    [(0, 3, []), (1, 3, [0]), (3, 3, [0, 1, 2]), (9, 3, [0, 4, 8]), (9, 1, [0]), (4, 3, [0, 2, 3])],
)
def test_samples_are_evenly_spaced_from_the_first_to_the_last(count, max_count, expected):
    assert evenly_spaced_indices(count, max_count) == expected
