"""Splat rows: what compositing needs of each Gaussian, in pieces of 16 bytes (kernels/rows.py)."""

from typing import NamedTuple

from torch import Tensor, int64

from warpgs.kernels.rows import row_parts
from warpgs.kernels.scan import SCAN_BLOCK_DIM

from .sort import new_counters

DEPTH_BITS = 31
"""Bits of a depth key: those of a positive float."""


class Rows(NamedTuple):
    """Packed splats.

    Attributes:
        packed: [N, parts, 4] rows.
        num_features: Number of features.
        with_depth: Whether depth is one more channel after the features.
    """

    packed: Tensor
    num_features: int
    with_depth: bool

    @property
    def num_channels(self) -> int:
        """Number of features, plus one with depth."""
        return self.num_features + int(self.with_depth)

    @property
    def opacities(self) -> Tensor:
        """[N] opacities; that of a culled splat is 0."""
        return self.packed[:, 1, 1].exp2()


class DepthOrder(NamedTuple):
    """Input of binning, which uses it up.

    Attributes:
        keys, gaussian_from_rank: [2 N] int32 keys and values of the depth sort, in the first half.
        scan_words: int64 words of the prefix sum of intersections (kernels/scan.py): [⌈N / SCAN_BLOCK_DIM⌉] zeros; on
            CPU, [N] without content.
        sort_counters: int32 zeros of the depth sort (``sort.new_counters``); None on CPU.
    """

    keys: Tensor
    gaussian_from_rank: Tensor
    scan_words: Tensor
    sort_counters: Tensor | None


def new_rows(features: Tensor, with_depth: bool) -> Rows:
    """Memory for the rows of N splats with [N, num_features] features."""
    N, num_features = features.shape
    return Rows(features.new_empty(N, row_parts(num_features + int(with_depth)), 4), num_features, with_depth)


def new_order(radii: Tensor) -> DepthOrder:
    """Memory for the order of as many splats as there are radii; it has no content."""
    N = radii.shape[0]
    num_words = -(-N // SCAN_BLOCK_DIM) if radii.is_cuda else N
    keys, values, words = radii.new_empty(2 * N), radii.new_empty(2 * N), radii.new_empty(num_words, dtype=int64)
    return DepthOrder(keys, values, words, new_counters(radii, N, DEPTH_BITS))
