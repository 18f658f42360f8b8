"""Pairs are sorted by their keys, and equal keys keep their order."""

import pytest
import torch

from tests.reference.sort import sort_pairs as reference_sort_pairs
from tests.scenes import generator
from warpgs.kernels.sort import PAIRS_PER_SEGMENT
from warpgs.ops.sort import new_counters, sort_pairs

CASES = [
    (1, 1),
    (2, 31),
    (31, 8),
    (1000, 4),
    (PAIRS_PER_SEGMENT, 9),
    (PAIRS_PER_SEGMENT + 1, 16),
    (9999, 17),
    (20_000, 31),
]
"""Numbers of pairs and of bits; several segments and both numbers of passes on CUDA."""


def random_keys(num_pairs: int, num_bits: int) -> torch.Tensor:
    """Every other key is one of a few, among them the lowest and the highest possible one, so that many are equal."""
    keys = torch.randint(1 << num_bits, (num_pairs,), generator=generator(num_bits), dtype=torch.int32)
    few = torch.cat([keys[:5], torch.tensor([0, (1 << num_bits) - 1], dtype=torch.int32)])
    keys[::2] = few[torch.arange(len(keys[::2])) * 7919 % len(few)]
    return keys


def sorted_pairs(keys: torch.Tensor, num_bits: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Sorted keys and, as values, where each of them came from."""
    n = len(keys)
    keys = torch.cat([keys, torch.full_like(keys, -1)])
    values = torch.arange(2 * n, dtype=torch.int32, device=keys.device)
    counters = new_counters(keys, n, num_bits)
    sort_pairs(keys, values, None if counters is None else counters.zero_(), num_bits)
    return keys[:n], values[:n]


@pytest.mark.parametrize(("num_pairs", "num_bits"), CASES)
def test_sorted_pairs_equal_the_reference(num_pairs, num_bits):
    keys = random_keys(num_pairs, num_bits)
    expected = reference_sort_pairs(keys.tolist(), list(range(num_pairs)))
    assert tuple(t.tolist() for t in sorted_pairs(keys, num_bits)) == expected
