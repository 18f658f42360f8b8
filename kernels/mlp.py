"""Backward pass of a layer of a perceptron, and of the ReLU and the bias before it (half precision).

    y = W h,   h = max(0, x),   v_x = (v_y W) · [h > 0],   v_bias = Σ over rows of v_x

The gradient of the last layer is scaled to the range of half precision before (``scale_gradients``).

The product is masked and summed before it is stored; ReLU on its own would read and write the whole matrix again. A
tile of ``TILE`` by ``TILE`` elements of v_x is computed at once: on CPU by a thread, on CUDA by a block of four warps,
which multiply 64 by 64 elements each on tensor cores, with sums in single precision. Sums over rows are taken per tile
and added up afterwards: without atomics, the result is deterministic.
"""

import functools

import warp as wp

from .lanes import native

TILE = 128
"""Rows and columns of a tile."""

BLOCK_DIM = 128
"""Threads of a CUDA block."""

PIECE = 8
"""Numbers of 16 bytes, which are loaded and stored at once."""

DEPTH, STAGES = 32, 3
"""Columns of v_y that are multiplied in one step, and steps whose factors are in shared memory at once: 48 KiB, which
every GPU with such tensor cores offers."""

_SIZES = (
    f"constexpr int TILE = {TILE}, THREADS = {BLOCK_DIM}, DEPTH = {DEPTH}, STAGES = {STAGES};"
    + """
const int rows = v_x.shape[0], columns = v_x.shape[1], depth = v_y.shape[1];
const int tiles_across = (columns + TILE - 1) / TILE;
const int first_row = tile / tiles_across * TILE, first_column = tile % tiles_across * TILE;
"""
)

# Factors are copied to shared memory in pieces of 16 bytes, while those of earlier steps are multiplied. Positions of
# pieces are permuted (by exclusive or), so that the eight rows that ldmatrix reads at once lie in different banks.
# Fragments are laid out as the PTX manual describes them for mma.m16n8k16: lane l holds rows l / 4 and l / 4 + 8.
# A number that is not negative is positive if and only if its bits are, read as an integer: pairs of numbers are
# compared at once, and NaN counts as positive, as in torch.
_CUDA = r"""
constexpr int ALONG = DEPTH / 8, ACROSS = TILE / 8;  // pieces of a row of the factors
constexpr int APART = THREADS / ACROSS, OWN_ROWS = TILE / APART;  // of the rows that a thread masks
extern __shared__ uint4 stages[];
const int tid = threadIdx.x, lane = tid & 31, warp = tid >> 5;
const int warp_row = (warp & 1) * 64, warp_column = (warp >> 1) * 64;

auto along = [](int row, int piece) { return row * ALONG + (piece ^ (row >> 1 & 3)); };
auto across = [](int row, int piece) { return row * ACROSS + (piece ^ (row & 7)); };
auto shared = [](const void* address) { return (unsigned)__cvta_generic_to_shared(address); };
auto copy = [&](uint4* target, const wp::half* source, bool is_inside) {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;"
        :: "r"(shared(target)), "l"(source), "r"(is_inside ? 16 : 0));
#else
    *target = is_inside ? *(const uint4*)source : make_uint4(0, 0, 0, 0);
#endif
};
auto load = [&](int step) {
    uint4* const left = stages + step % STAGES * 2 * TILE * ALONG;
    uint4* const right = left + TILE * ALONG;
    for (int i = 0; i < ALONG; ++i) {
        const int index = tid + i * THREADS;
        int row = index / ALONG, piece = index % ALONG, k = step * DEPTH + piece * 8;
        copy(left + along(row, piece), v_y.data + (long long)(first_row + row) * depth + k,
            first_row + row < rows && k < depth);
        row = index / ACROSS, piece = index % ACROSS, k = step * DEPTH + row;
        const int column = first_column + piece * 8;
        copy(right + across(row, piece), w.data + (long long)k * w.shape[1] + column, k < depth && column < columns);
    }
};
auto commit = [] {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.commit_group;");
#endif
};

float sum[4][8][4] = {};  // products of 16 rows and 8 columns, of which a lane holds 4
const int num_steps = (depth + DEPTH - 1) / DEPTH;
for (int step = 0; step < STAGES - 1; ++step) {
    if (step < num_steps) load(step);
    commit();
}
for (int step = 0; step < num_steps; ++step) {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_group %0;" :: "n"(STAGES - 2));
#endif
    __syncthreads();
    if (step + STAGES - 1 < num_steps) load(step + STAGES - 1);
    commit();
    const uint4* const left = stages + step % STAGES * 2 * TILE * ALONG;
    const uint4* const right = left + TILE * ALONG;
    #pragma unroll
    for (int part = 0; part < DEPTH / 16; ++part) {
        unsigned a[4][4], b[4][4];
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            const uint4* const source = left + along(warp_row + i * 16 + (lane & 15), part * 2 + (lane >> 4));
            asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                : "=r"(a[i][0]), "=r"(a[i][1]), "=r"(a[i][2]), "=r"(a[i][3]) : "r"(shared(source)));
        }
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            const uint4* const source = right + across(part * 16 + (lane & 15), warp_column / 8 + j * 2 + (lane >> 4));
            asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                : "=r"(b[j][0]), "=r"(b[j][1]), "=r"(b[j][2]), "=r"(b[j][3]) : "r"(shared(source)));
        }
        #pragma unroll
        for (int i = 0; i < 4; ++i)
            #pragma unroll
            for (int j = 0; j < 8; ++j) {
                float* const d = sum[i][j];
                const unsigned b0 = b[j / 2][j % 2 * 2], b1 = b[j / 2][j % 2 * 2 + 1];
#if __CUDA_ARCH__ >= 800
                asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
                    "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
                    : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
                    : "r"(a[i][0]), "r"(a[i][1]), "r"(a[i][2]), "r"(a[i][3]), "r"(b0), "r"(b1));
#else
                asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 "
                    "{%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
                    : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3]) : "r"(a[i][0]), "r"(a[i][1]), "r"(b0));
                asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 "
                    "{%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
                    : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3]) : "r"(a[i][2]), "r"(a[i][3]), "r"(b1));
#endif
            }
    }
}

// From here on a thread processes one piece of every APART-th row. Features arrive while the products are written to
// shared memory.
const int first_own = tid / ACROSS, piece = tid % ACROSS, column = first_column + piece * 8;
auto is_inside = [&](int row) { return first_row + row < rows && column < columns; };
uint4 features[OWN_ROWS];
#pragma unroll
for (int i = 0; i < OWN_ROWS; ++i) {
    const int row = first_own + i * APART;
    if (is_inside(row)) features[i] = *(const uint4*)(h.data + (long long)(first_row + row) * h.shape[1] + column);
}
__syncthreads();
#pragma unroll
for (int i = 0; i < 4; ++i)
    #pragma unroll
    for (int j = 0; j < 8; ++j)
        #pragma unroll
        for (int e = 0; e < 4; e += 2) {
            unsigned short low, high;
            asm("cvt.rn.f16.f32 %0, %1;" : "=h"(low) : "f"(sum[i][j][e]));
            asm("cvt.rn.f16.f32 %0, %1;" : "=h"(high) : "f"(sum[i][j][e + 1]));
            uint4* const target = stages + across(warp_row + i * 16 + e * 4 + (lane >> 2), warp_column / 8 + j);
            ((unsigned*)target)[lane & 3] = (unsigned)high << 16 | low;
        }
__syncthreads();
float totals[8] = {};
#pragma unroll
for (int i = 0; i < OWN_ROWS; ++i) {
    const int row = first_own + i * APART;
    if (!is_inside(row)) continue;
    uint4 masked = stages[across(row, piece)];
    masked.x &= __vcmpgts2(features[i].x, 0u);
    masked.y &= __vcmpgts2(features[i].y, 0u);
    masked.z &= __vcmpgts2(features[i].z, 0u);
    masked.w &= __vcmpgts2(features[i].w, 0u);
    *(uint4*)(v_x.data + (long long)(first_row + row) * columns + column) = masked;
    for (int k = 0; k < 8; ++k) totals[k] += (float)((const wp::half*)&masked)[k];
}
__syncthreads();
float* const of_warps = (float*)stages;
for (int k = 0; k < 8; ++k) {
    totals[k] += __shfl_xor_sync(0xffffffffu, totals[k], 16);  // two rows of a warp
    if (lane < 16) of_warps[warp * TILE + piece * 8 + k] = totals[k];
}
__syncthreads();
if (first_column + tid < columns)
    sums.data[(long long)(tile / tiles_across) * columns + first_column + tid] =
        of_warps[tid] + of_warps[TILE + tid] + of_warps[2 * TILE + tid] + of_warps[3 * TILE + tid];
"""

_CPU = """
const int height = wp::min(rows - first_row, TILE), width = wp::min(columns - first_column, TILE);
const wp::half* const left = v_y.data + (long long)first_row * depth;
float sum[TILE][TILE] = {};
for (int k = 0; k < depth; ++k) {
    const wp::half* const right = w.data + (long long)k * w.shape[1] + first_column;
    float line[TILE];
    for (int column = 0; column < width; ++column) line[column] = (float)right[column];
    for (int row = 0; row < height; ++row) {
        const float factor = (float)left[row * depth + k];
        for (int column = 0; column < width; ++column) sum[row][column] += factor * line[column];
    }
}
for (int column = 0; column < width; ++column) {
    float total = 0.0f;
    for (int row = 0; row < height; ++row) {
        const long long at = first_row + row;
        const wp::half feature = h.data[at * h.shape[1] + first_column + column];
        const wp::half masked = (short)feature.u > 0 ? wp::half(sum[row][column]) : wp::half(0.0f);
        v_x.data[at * columns + first_column + column] = masked;
        total += (float)masked;
    }
    sums.data[(long long)(tile / tiles_across) * columns + first_column + column] = total;
}
"""


@wp.func_native(native(_SIZES + _CUDA, _SIZES + _CPU))
def multiply_tile(
    tile: int,
    v_y: wp.array2d[wp.float16],
    w: wp.array2d[wp.float16],
    h: wp.array2d[wp.float16],
    v_x: wp.array2d[wp.float16],
    sums: wp.array2d[float],
): ...


@functools.cache
def make_layer_bwd(on_cuda: bool) -> wp.Kernel:
    """Kernel that computes a tile of v_x [N, columns] = (v_y w) · [h > 0], and its sums over rows.

    ``w`` [columns of ``v_y``, ≥ columns] and ``h`` [N, ≥ columns] may have more columns, which are ignored. All numbers
    of columns are multiples of 8. ``sums`` is [tiles along the rows, columns]. There are ``BLOCK_DIM`` threads per tile
    on CUDA, and one on CPU.
    """
    threads = BLOCK_DIM if on_cuda else 1

    @wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(BLOCK_DIM, 2), module="unique")
    def layer_bwd(
        first: int,
        v_y: wp.array2d[wp.float16],
        w: wp.array2d[wp.float16],
        h: wp.array2d[wp.float16],
        v_x: wp.array2d[wp.float16],
        sums: wp.array2d[float],
    ):
        if wp.static(on_cuda):
            # Only a tile reserves more shared memory than Warp leaves of 48 KiB. On CPU its memory is one per process.
            wp.tile_empty(shape=wp.static(2 * STAGES * TILE * DEPTH), dtype=wp.float16, storage="shared")
        multiply_tile((first + wp.tid()) / wp.static(threads), v_y, w, h, v_x, sums)

    return layer_bwd


@wp.kernel(enable_backward=False)
def scale_gradients(
    first: int,
    gradients: wp.array2d[float],
    scale: wp.array[float],
    begin: int,
    scaled: wp.array2d[wp.float16],
    sums: wp.array2d[float],
):
    """Thread (chunk, column): scales rows chunk, chunk + chunks, … of one column, and sums them unscaled.

    Column k of ``gradients`` becomes column ``begin`` + k of ``scaled``, and row ``begin`` + k of ``sums`` [columns,
    chunks].
    """
    thread = first + wp.tid()
    chunk = thread // gradients.shape[1]
    column = thread - chunk * gradients.shape[1]
    sum = float(0.0)
    for row in range(chunk, gradients.shape[0], sums.shape[1]):
        value = gradients[row, column]
        scaled[row, begin + column] = wp.float16(value * scale[0])
        sum += value
    sums[begin + column, chunk] = sum
