"""Stable radix sort of pairs (kernels/sort.py; on CPU that of Warp)."""

import warp as wp
from torch import Tensor

from warpgs.kernels import sort as kernels
from warpgs.runtime import profiling
from warpgs.runtime.launch import launch

MAX_BLOCKS = 512
"""Maximum number of blocks: more than a large GPU runs at once; those that begin late find no job."""

MAX_CHUNKS = 256
"""Chunks in which digits are counted: enough to saturate memory, few enough to be added up quickly."""


def num_passes(num_bits: int) -> int:
    """Number of passes on CUDA; it is even, so that the last one writes to the first half of the buffers."""
    return 2 if num_bits <= 2 * kernels.DIGIT_BITS else kernels.MAX_PASSES


def new_counters(like: Tensor, num_pairs: int, num_bits: int) -> Tensor | None:
    """Memory without content for the counters of a sort, which must be zeros when it begins; None on CPU."""
    if not like.is_cuda:
        return None
    num_segments = -(-num_pairs // kernels.PAIRS_PER_SEGMENT)
    return like.new_empty(kernels.WORDS_BEGIN + num_passes(num_bits) * num_segments * kernels.DIGITS)


def sort_pairs(keys: Tensor, values: Tensor, counters: Tensor | None, num_bits: int) -> None:
    """Sorts pairs of a key and a value by their keys; equal keys keep their order.

    Args:
        keys: [2 n] int32, in the first half n keys ≥ 0 and < 2 ** ``num_bits``; the second half is scratch memory.
        values: [2 n] int32, likewise.
        counters: Zeros from ``new_counters``, which are used up.
        num_bits: At most 31.

    Raises:
        ValueError: If there are too many pairs.
    """
    n = keys.shape[0] // 2
    if counters is None:
        begun = profiling.begin(keys)
        _native.wp_radix_sort_pairs_int_host(keys.data_ptr(), values.data_ptr(), n, 0, num_bits, values.element_size())
        profiling.end("sort_pairs", begun, keys)
        return
    if n >= kernels.MAX_PAIRS:
        raise ValueError(f"fewer than {kernels.MAX_PAIRS} pairs can be sorted, got {n}")
    num_segments, block_dim = -(-n // kernels.PAIRS_PER_SEGMENT), kernels.SORT_BLOCK_DIM
    kernel, inputs = kernels.make_sort_pairs(num_passes(num_bits)), (keys, values, counters, n)
    threads, segments_per_chunk = min(num_segments, MAX_BLOCKS) * block_dim, -(-num_segments // MAX_CHUNKS)
    launch(kernel, threads, *inputs, segments_per_chunk, block_dim=block_dim)


_native = wp.get_device("cpu").runtime.core
"""Warp's library: ``wp.utils.radix_sort_pairs`` takes Warp's arrays, which take longer to make than a small sort."""
