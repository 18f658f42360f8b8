"""Sum over all threads in front, within a kernel: decoupled look-back.

D. Merrill and M. Garland, "Single-pass Parallel Prefix Scan with Decoupled Look-back", NVIDIA NVR-2016-002. Each block
sums up its own threads and publishes that sum, then adds the sums of the blocks in front of it, back to the closest one
that has already published its sum with all in front. A block only waits for blocks with lower indices. The GPU starts
blocks in the order of their indices, which CUB's scan relies on, too, so these have at least started.

One word for each block holds ``4 * sum + state``: state 0 until the block has published anything, 1 for its own sum, 2
for its sum with all in front. A word is written at once, so no other memory needs to be ordered.

On CPU, threads run in any order: there the words are the sums up to and with each thread, from before the launch.
"""

import warp as wp

from .lanes import native

SCAN_BLOCK_DIM = wp.constant(256)
"""Threads of a CUDA block of a kernel that calls ``running_sum``."""

Span = wp.types.vector(length=2, dtype=wp.int64)


@wp.func_native(
    native(
        """
        __shared__ long long warp_sums[256 / 32];
        __shared__ long long in_front;
        volatile long long* const words = ends.data;
        const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, block = thread / 256;
        long long sum = x;
        for (int o = 1; o < 32; o <<= 1) {
            const long long below = __shfl_up_sync(0xffffffffu, sum, o);
            if (lane >= o) sum += below;
        }
        if (lane == 31) warp_sums[warp] = sum;
        __syncthreads();
        long long before = sum - x, total = 0;
        for (int k = 0; k < 256 / 32; ++k) {
            if (k == warp) before += total;
            total += warp_sums[k];
        }
        if (warp == 0) {
            long long prefix = 0;
            if (block > 0) {
                if (lane == 0) words[block] = 4 * total + 1;
                for (int last = block - 1, complete = 0; !complete; last -= 32) {
                    long long word = 2;
                    do {
                        if (last >= lane) word = words[last - lane];
                    } while (__any_sync(0xffffffffu, word == 0));
                    const unsigned ballot = __ballot_sync(0xffffffffu, (word & 3) == 2);
                    long long part = !ballot || lane < __ffs(ballot) ? word >> 2 : 0;
                    for (int o = 16; o > 0; o >>= 1) part += __shfl_xor_sync(0xffffffffu, part, o);
                    prefix += part;
                    complete = ballot != 0;
                }
            }
            if (lane == 0) {
                words[block] = 4 * (prefix + total) + 2;
                in_front = prefix;
            }
        }
        __syncthreads();
        before += in_front;
        return wp::vec_t<2, long long>(before, before + x);
        """,
        "return wp::vec_t<2, long long>(thread > 0 ? ends.data[thread - 1] : 0, ends.data[thread]);",
    )
)
def running_sum(x: int, thread: int, ends: wp.array[wp.int64]) -> Span:
    """Sum of ``x`` over the threads in front of ``thread``, and that up to and with it; all of a block must call this.

    Args:
        x: Not negative; on CPU it is not used.
        thread: Its index, from 0.
        ends: A zero for each block; on CPU, the sums of ``x`` up to each thread.
    """
    ...


@wp.func_native(
    native(
        """
        volatile long long* const last = ends.data + ends.shape[0] - 1;
        long long word = *last;
        while ((word & 3) != 2) word = *last;
        return word >> 2;
        """,
        "return ends.data[ends.shape[0] - 1];",
    )
)
def sum_of_all(ends: wp.array[wp.int64]) -> wp.int64:
    """The sum over all threads; blocks after those that call ``running_sum`` may wait for it here."""
    ...
