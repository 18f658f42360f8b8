"""Prefix sum over all threads of a kernel, within that kernel: decoupled look-back.

D. Merrill and M. Garland, "Single-pass Parallel Prefix Scan with Decoupled Look-back", NVIDIA NVR-2016-002. Each block
publishes its aggregate, the sum over its own threads, then adds the aggregates of the preceding blocks, back to the
closest one that has already published its inclusive prefix sum. A block only waits for blocks with lower indices. The
GPU starts the blocks of a one-dimensional grid in the order of their indices, which CUB's scan relies on, too, so these
have at least started.

One word per block holds ``4 * sum + state``: state 0 before the block has published anything, 1 with its aggregate, 2
with its inclusive prefix sum. A word is written by one 64-bit store, so no fence is needed.

On CPU, threads run in any order: there the words are the inclusive prefix sums themselves, one per thread, computed
before the launch.
"""

import warp as wp

from .lanes import native, warp_prefix_sum

SCAN_BLOCK_DIM = wp.constant(256)
"""Threads of a CUDA block of a kernel that calls ``prefix_sums``."""

PrefixSums = wp.types.vector(length=2, dtype=wp.int64)
"""Exclusive and inclusive prefix sum of a thread."""


@wp.func_native(
    native(
        f"""
        constexpr int num_warps = {SCAN_BLOCK_DIM} / 32;
        __shared__ long long warp_sums[num_warps];
        __shared__ long long shared_prefix;
        volatile long long* const all_words = words.data;
        const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, block = thread / {SCAN_BLOCK_DIM};
        long long sum = x;
        {warp_prefix_sum("long long", "sum")}
        if (lane == 31) warp_sums[warp] = sum;
        __syncthreads();
        long long exclusive = sum - x, aggregate = 0;
        for (int k = 0; k < num_warps; ++k) {{
            if (k == warp) exclusive += aggregate;
            aggregate += warp_sums[k];
        }}
        if (warp == 0) {{
            long long prefix = 0;
            if (block > 0) {{
                if (lane == 0) all_words[block] = 4 * aggregate + 1;
                for (int last = block - 1, complete = 0; !complete; last -= 32) {{
                    long long word = 2;
                    do {{
                        if (last >= lane) word = all_words[last - lane];
                    }} while (__any_sync(0xffffffffu, word == 0));
                    const unsigned ballot = __ballot_sync(0xffffffffu, (word & 3) == 2);
                    long long part = !ballot || lane < __ffs(ballot) ? word >> 2 : 0;
                    for (int o = 16; o > 0; o >>= 1) part += __shfl_xor_sync(0xffffffffu, part, o);
                    prefix += part;
                    complete = ballot != 0;
                }}
            }}
            if (lane == 0) {{
                all_words[block] = 4 * (prefix + aggregate) + 2;
                shared_prefix = prefix;
            }}
        }}
        __syncthreads();
        exclusive += shared_prefix;
        return wp::vec_t<2, long long>(exclusive, exclusive + x);
        """,
        "return wp::vec_t<2, long long>(thread > 0 ? words.data[thread - 1] : 0, words.data[thread]);",
    )
)
def prefix_sums(x: int, thread: int, words: wp.array[wp.int64]) -> PrefixSums:
    """Prefix sums of ``x``; all threads of a block must call this.

    Args:
        x: Not negative; on CPU it is not used.
        thread: Index of the thread, from 0.
        words: A zero for each block; on CPU, the inclusive prefix sums.
    """
    ...


@wp.func_native(
    native(
        """
        volatile long long* const last = words.data + words.shape[0] - 1;
        long long word = *last;
        while ((word & 3) != 2) word = *last;
        return word >> 2;
        """,
        "return words.data[words.shape[0] - 1];",
    )
)
def wait_for_sum(words: wp.array[wp.int64]) -> wp.int64:
    """The sum over all threads, in the kernel that computes it: blocks after those of ``prefix_sums`` wait for it."""
    ...


@wp.func_native(native("return words.data[words.shape[0] - 1] >> 2;", "return words.data[words.shape[0] - 1];"))
def stored_sum(words: wp.array[wp.int64]) -> wp.int64:
    """The sum over all threads, in a later kernel."""
    ...
