"""Stable radix sort of pairs on CUDA in a single kernel: "onesweep".

A. Adinets and D. Merrill, "Onesweep: A Faster Least Significant Digit Radix Sort for GPUs", arXiv 2206.01784. First all
digits of all keys are counted. Then each pass sorts by one digit, from the lowest to the highest: a block sorts a
segment of the pairs in shared memory, and learns by decoupled look-back (see ``scan``) how many pairs of each digit the
preceding segments have.

All of that is one list of jobs, which blocks take in turn: to count the digits of a chunk of keys, or to sort a segment
in a pass, which begins after all jobs before that pass. Whatever a block waits for was taken by another one earlier, so
that other one is running: no two blocks wait for each other, however many of them the GPU runs at once.

The words of the look-back hold a number of pairs in the low 30 bits and a state in the two bits above: 0 before a
segment has published anything, 1 with its own number, 2 with that of all segments up to it.
"""

import functools

import warp as wp

from .lanes import native, warp_prefix_sum

DIGIT_BITS = 8

DIGITS = 1 << DIGIT_BITS

MAX_PASSES = 4
"""Enough for 32 bits."""

COUNTS_BEGIN = 8
"""Index of the first counter of pairs, one for each digit of each pass. Before it are those of the jobs taken, and of
the jobs done in each round, which is the counting or a pass."""

WORDS_BEGIN = COUNTS_BEGIN + MAX_PASSES * DIGITS
"""Index of the first word of the look-back, one for each digit of each segment in each pass."""

SORT_BLOCK_DIM = 512
"""Threads of a CUDA block of a sort."""

PAIRS_PER_THREAD = 8

PAIRS_PER_SEGMENT = SORT_BLOCK_DIM * PAIRS_PER_THREAD

MAX_PAIRS = 1 << 30
"""There must be fewer pairs than this."""

LOOK_BACK = 4
"""Words that a thread reads at once in the look-back, so that the loads overlap."""

_CONSTANTS = f"""
constexpr int threads = {SORT_BLOCK_DIM}, num_warps = threads / 32, per_thread = {PAIRS_PER_THREAD};
constexpr int per_segment = threads * per_thread, look_back = {LOOK_BACK}, max_pairs = {MAX_PAIRS};
constexpr int digit_bits = {DIGIT_BITS}, digits = {DIGITS};
constexpr unsigned all = 0xffffffffu, mask = digits - 1, own_only = 1u << 30, inclusive = 2u << 30;
int* const num_taken = counters.data;
int* const num_done = counters.data + 1;
int* const counts = counters.data + {COUNTS_BEGIN};
volatile unsigned* const all_words = (volatile unsigned*)counters.data + {WORDS_BEGIN};
"""

# What other blocks wrote in an earlier round is read by __ldcg, because caches of level 1 are not coherent.
_SORT = (
    """
__shared__ int positions[num_warps][digits];  // in the segment, of the next pair of a warp that has this digit
__shared__ int staged[per_segment];
__shared__ int shifts[digits];  // from a position in the segment to that in the output
__shared__ long long warp_sums[digits / 32];
__shared__ int job;
const int tid = threadIdx.x, lane = tid & 31, warp = tid >> 5;
const int num_segments = (num_pairs - 1) / per_segment + 1;
const int num_chunks = (num_pairs - 1) / (segments_per_chunk * per_segment) + 1;

while (true) {
    if (tid == 0) job = atomicAdd(num_taken, 1);
    __syncthreads();
    const int this_round = job < num_chunks ? 0 : (job - num_chunks) / num_segments + 1;
    const int index = this_round == 0 ? job : (job - num_chunks) % num_segments;
    if (this_round > num_passes) return;

    if (this_round == 0) {
        // Four copies of each number, because lanes that add to the same one take turns.
        static_assert(num_passes * 4 <= num_warps, "");
        int* const copies = &positions[0][0];
        for (int k = tid; k < num_passes * digits * 4; k += threads) copies[k] = 0;
        __syncthreads();
        const int end = min(num_pairs, (index + 1) * segments_per_chunk * per_segment);
        for (int k = index * segments_per_chunk * per_segment + tid; k < end; k += per_segment) {
            unsigned key[per_thread];
            #pragma unroll
            for (int i = 0; i < per_thread; ++i) if (k + i * threads < end) key[i] = keys.data[k + i * threads];
            #pragma unroll
            for (int i = 0; i < per_thread; ++i)
                if (k + i * threads < end)
                    for (int pass = 0; pass < num_passes; ++pass)
                        atomicAdd(copies + (pass * digits + (key[i] >> pass * digit_bits & mask)) * 4 + (tid & 3), 1);
        }
        __syncthreads();
        for (int k = tid; k < num_passes * digits; k += threads) {
            const int sum = copies[4 * k] + copies[4 * k + 1] + copies[4 * k + 2] + copies[4 * k + 3];
            if (sum > 0) atomicAdd(counts + k, sum);
        }
    } else {
        const int num_jobs = this_round == 1 ? num_chunks : num_segments;  // of the preceding round
        if (tid == 0) while (((volatile int*)num_done)[this_round - 1] < num_jobs) __nanosleep(32);
        __threadfence();
        __syncthreads();
        const int pass = this_round - 1, shift = pass * digit_bits;
        const int source = pass & 1 ? num_pairs : 0, target = num_pairs - source;
        const int begin = index * per_segment, length = min(num_pairs - begin, per_segment);
        const int first = warp * 32 * per_thread + lane;  // a thread's pairs are 32 apart
        const unsigned* const in_keys = (unsigned*)keys.data + source + begin + first;
        const int* const in_values = values.data + source + begin + first;

        // Positions among the pairs of a warp that have the same digit. Missing pairs are sorted to the end.
        unsigned own[per_thread];
        int own_value[per_thread], own_position[per_thread];
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) own[k] = first + 32 * k < length ? __ldcg(in_keys + 32 * k) : all;
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) if (first + 32 * k < length) own_value[k] = __ldcg(in_values + 32 * k);
        for (int digit = lane; digit < digits; digit += 32) positions[warp][digit] = 0;
        __syncwarp();
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            const unsigned digit = own[k] >> shift & mask;
            unsigned peers = all;
            #pragma unroll
            for (int bit = 0; bit < digit_bits; ++bit) {
                const bool is_set = digit >> bit & 1u;
                const unsigned ballot = __ballot_sync(all, is_set);
                peers &= is_set ? ballot : ~ballot;
            }
            const int before = positions[warp][digit], rank = __popc(peers & ((1u << lane) - 1u));
            __syncwarp();
            if (rank == 0) positions[warp][digit] = before + __popc(peers);
            __syncwarp();
            own_position[k] = before + rank;
        }
        __syncthreads();

        // A thread for each digit. One prefix sum is two: of all pairs in the high half, of the segment's in the low.
        volatile unsigned* const words = all_words + (long long)pass * num_segments * digits + tid;
        int num_here = 0;
        long long numbers = 0, sum = 0;
        if (tid < digits) {
            for (int w = 0; w < num_warps; ++w) {
                const int number = positions[w][tid];
                positions[w][tid] = num_here;
                num_here += number;
            }
            words[index * digits] = (index > 0 ? own_only : inclusive) | num_here;
            numbers = (long long)__ldcg(counts + pass * digits + tid) << 32 | num_here;
            sum = numbers;
"""
    + warp_prefix_sum("long long", "sum")
    + """
            if (lane == 31) warp_sums[warp] = sum;
        }
        __syncthreads();
        if (tid < digits) {
            sum -= numbers;
            for (int w = 0; w < warp; ++w) sum += warp_sums[w];
            const int local = (int)sum;
            for (int w = 0; w < num_warps; ++w) positions[w][tid] += local;
            int num_before = 0;
            bool complete = index == 0;
            for (int last = index - 1; !complete;) {
                unsigned word[look_back];
                #pragma unroll
                for (int k = 0; k < look_back; ++k) word[k] = last >= k ? words[(last - k) * digits] : inclusive;
                #pragma unroll
                for (int k = 0; k < look_back; ++k) {
                    if (complete || word[k] >> 30 == 0) break;
                    num_before += word[k] & (max_pairs - 1);
                    complete = word[k] >> 30 == 2;
                    --last;
                }
            }
            if (index > 0) words[index * digits] = inclusive | (num_before + num_here);
            shifts[tid] = (int)(sum >> 32) + num_before - local;
        }
        __syncthreads();

        // Through shared memory, so that adjacent threads write to adjacent addresses.
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            own_position[k] += positions[warp][own[k] >> shift & mask];
            staged[own_position[k]] = own[k];
        }
        __syncthreads();
        int outputs[per_thread];
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            const int position = k * threads + tid;
            const unsigned key = staged[position];
            outputs[k] = target + shifts[key >> shift & mask] + position;
            if (position < length) keys.data[outputs[k]] = key;
        }
        __syncthreads();
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) if (first + 32 * k < length) staged[own_position[k]] = own_value[k];
        __syncthreads();
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            const int position = k * threads + tid;
            if (position < length) values.data[outputs[k]] = staged[position];
        }
    }
    __threadfence();
    __syncthreads();
    if (tid == 0) atomicAdd(num_done + this_round, 1);
}
"""
)


@functools.cache
def make_sort_pairs(num_passes: int) -> wp.Kernel:
    """Kernel that sorts pairs by the lowest ``DIGIT_BITS * num_passes`` bits of their keys.

    Even passes read the first half of the buffers and write to the second half, odd passes vice versa. It is launched
    in blocks of ``SORT_BLOCK_DIM`` threads, any number of them.
    """

    @wp.func_native(native(f"constexpr int num_passes = {num_passes};{_CONSTANTS}{_SORT}", ""))
    def run_jobs(
        keys: wp.array[int],
        values: wp.array[int],
        counters: wp.array[int],
        num_pairs: int,
        segments_per_chunk: int,
    ): ...

    @wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(SORT_BLOCK_DIM, 2), module="unique")
    def sort_pairs(
        first: int,
        keys: wp.array[int],
        values: wp.array[int],
        counters: wp.array[int],
        num_pairs: int,
        segments_per_chunk: int,
    ):
        run_jobs(keys, values, counters, num_pairs, segments_per_chunk)

    return sort_pairs
