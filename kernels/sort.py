"""Stable radix sort of pairs on CUDA in a single kernel: "onesweep".

A. Adinets and D. Merrill, "Onesweep: A Faster Least Significant Digit Radix Sort for GPUs", arXiv 2206.01784. First all
digits of all keys are counted. Then each pass sorts by one digit, from the lowest to the highest: a block sorts a tile
of pairs in shared memory, and learns by decoupled look-back (see ``scan``) how many pairs of each digit the preceding
tiles have.

All of that is one list of jobs, which blocks take in turn: to count a chunk of keys, or to sort a tile in a pass, which
begins after all jobs of the preceding step. Whatever a block waits for was taken by another one earlier, so that other
one is running: no two blocks wait for each other, however many of them the GPU runs at once.

The words of the look-back hold a number of pairs in the low 30 bits and a state in the two bits above: 0 before a tile
has published anything, 1 with its own number, 2 with that of all tiles up to it.
"""

import functools

import warp as wp

from .lanes import native

MAX_DIGIT_BITS = 8
"""Maximum number of bits of a digit."""

MAX_PASSES = 4
"""Enough for 32 bits."""

DIGITS = 1 << MAX_DIGIT_BITS
"""Counters of a pass; with fewer bits some are not used."""

HEADER = 8 + MAX_PASSES * DIGITS
"""Counters before the words of the look-back: the number of jobs taken, those done of each step, and the digits."""

SORT_BLOCK_DIM = 512
"""Threads of a CUDA block of a sort."""

PAIRS_PER_THREAD = 8

PAIRS_PER_TILE = SORT_BLOCK_DIM * PAIRS_PER_THREAD

MAX_PAIRS = 1 << 30
"""There must be fewer pairs than this."""

LOOK_BACK = 4
"""Words that a thread reads at once in the look-back, so that the loads overlap."""

_CONSTANTS = f"""
constexpr int threads = {SORT_BLOCK_DIM}, num_warps = threads / 32, per_thread = {PAIRS_PER_THREAD};
constexpr int per_tile = threads * per_thread, digits = {DIGITS}, max_passes = {MAX_PASSES}, look_back = {LOOK_BACK};
constexpr unsigned all = 0xffffffffu, mask = (1u << digit_bits) - 1u, max_pairs = {MAX_PAIRS}, own_only = 1u << 30,
    inclusive = 2u << 30;
"""

# What other blocks wrote in an earlier step is read by __ldcg, because caches of level 1 are not coherent.
_SORT = """
__shared__ int positions[num_warps][digits];  // in the tile, of the next pair of a warp that has this digit
__shared__ int staged[per_tile];
__shared__ int shifts[digits];  // from a position in the tile to that in the output
__shared__ long long warp_sums[digits / 32];
__shared__ int job;
const int tid = threadIdx.x, lane = tid & 31, warp = tid >> 5;
const int num_tiles = (num_pairs - 1) / per_tile + 1;
const int num_chunks = (num_pairs - 1) / (tiles_per_chunk * per_tile) + 1;
int* const num_taken = counters.data;
int* const num_done = counters.data + 1;
int* const counts = counters.data + 8;
volatile unsigned* const all_words = (volatile unsigned*)counters.data + 8 + max_passes * digits;

while (true) {
    if (tid == 0) job = atomicAdd(num_taken, 1);
    __syncthreads();
    const int step = job < num_chunks ? 0 : (job - num_chunks) / num_tiles + 1;
    const int index = step == 0 ? job : (job - num_chunks) % num_tiles;
    if (step > num_passes) return;

    if (step == 0) {
        // Four copies of each number, because lanes that add to the same one take turns.
        static_assert(num_passes * 4 <= num_warps, "");
        int* const copies = &positions[0][0];
        for (int k = tid; k < num_passes * digits * 4; k += threads) copies[k] = 0;
        __syncthreads();
        const int end = min(num_pairs, (index + 1) * tiles_per_chunk * per_tile);
        for (int k = index * tiles_per_chunk * per_tile + tid; k < end; k += per_tile) {
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
        const int num_jobs = step == 1 ? num_chunks : num_tiles;  // of the preceding step
        if (tid == 0) while (((volatile int*)num_done)[step - 1] < num_jobs) __nanosleep(32);
        __threadfence();
        __syncthreads();
        const int pass = step - 1, shift = pass * digit_bits;
        const int source = pass & 1 ? num_pairs : 0, target = num_pairs - source;
        const int begin = index * per_tile, length = min(num_pairs - begin, per_tile);
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

        // A thread for each digit. One sum over the digits is two: of all pairs in the high half, of the tile's below.
        volatile unsigned* const words = all_words + (long long)pass * num_tiles * digits + tid;
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
            for (int o = 1; o < 32; o <<= 1) {
                const long long below = __shfl_up_sync(all, sum, o);
                if (lane >= o) sum += below;
            }
            if (lane == 31) warp_sums[warp] = sum;
        }
        __syncthreads();
        if (tid < digits) {
            sum -= numbers;
            for (int w = 0; w < warp; ++w) sum += warp_sums[w];
            const int local = (int)sum;
            for (int w = 0; w < num_warps; ++w) positions[w][tid] += local;
            int num_before = 0;
            bool complete = index == 0 || tid > mask;
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

        // Through shared memory, so that neighbouring threads write to neighbouring places.
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            own_position[k] += positions[warp][own[k] >> shift & mask];
            staged[own_position[k]] = own[k];
        }
        __syncthreads();
        int places[per_thread];
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            const int position = k * threads + tid;
            const unsigned key = staged[position];
            places[k] = target + shifts[key >> shift & mask] + position;
            if (position < length) keys.data[places[k]] = key;
        }
        __syncthreads();
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) if (first + 32 * k < length) staged[own_position[k]] = own_value[k];
        __syncthreads();
        #pragma unroll
        for (int k = 0; k < per_thread; ++k) {
            const int position = k * threads + tid;
            if (position < length) values.data[places[k]] = staged[position];
        }
    }
    __threadfence();
    __syncthreads();
    if (tid == 0) atomicAdd(num_done + step, 1);
}
"""


@functools.cache
def make_sort_pairs(digit_bits: int, num_passes: int) -> wp.Kernel:
    """Kernel that sorts pairs by the lowest ``digit_bits * num_passes`` bits of their keys.

    Even passes read the first half of the buffers and write to the second half, odd passes vice versa. It is launched
    in blocks of ``SORT_BLOCK_DIM`` threads, any number of them.
    """
    constants = f"constexpr int digit_bits = {digit_bits}, num_passes = {num_passes};"

    @wp.func_native(native(constants + _CONSTANTS + _SORT, ""))
    def run_jobs(
        keys: wp.array[int],
        values: wp.array[int],
        counters: wp.array[int],
        num_pairs: int,
        tiles_per_chunk: int,
    ): ...

    @wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(SORT_BLOCK_DIM, 2), module="unique")
    def sort_pairs(
        first: int,
        keys: wp.array[int],
        values: wp.array[int],
        counters: wp.array[int],
        num_pairs: int,
        tiles_per_chunk: int,
    ):
        run_jobs(keys, values, counters, num_pairs, tiles_per_chunk)

    return sort_pairs
