"""Backward pass of a layer of a perceptron, and of the ReLU and the bias before it (half precision).

    y = W h,   h = max(0, x),   v_x = (v_y W) · [h > 0],   v_bias = Σ over rows of v_x

``scale_gradients`` first scales the gradient of the last layer's outputs to the range of half precision.

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

SLICE, BUFFERS = 32, 3
"""Columns of v_y, and rows of W, that are multiplied between two barriers, and number of such slices in shared memory:
48 KiB, so that two blocks fit on a multiprocessor also where it has 100 KiB."""

_SIZES = (
    f"constexpr int TILE = {TILE}, THREADS = {BLOCK_DIM}, SLICE = {SLICE}, BUFFERS = {BUFFERS};"
    + """
const int rows = v_x.shape[0], columns = v_x.shape[1], inner = v_y.shape[1];
const int tiles_across = (columns + TILE - 1) / TILE;
const int first_row = tile / tiles_across * TILE, first_column = tile % tiles_across * TILE;
"""
)

# Slices of v_y (a) and W (b) are copied to shared memory in pieces of 16 bytes, 8 numbers, while earlier ones are
# multiplied. The positions of pieces are permuted by exclusive or, so that the eight rows that ldmatrix reads at once
# lie in different banks. Fragments are laid out as in the PTX manual, mma.m16n8k16: lane l holds rows l / 4 and
# l / 4 + 8. GPUs before compute capability 8.0 multiply half as much at once, and do not copy in the background.
#
# The mask compares two half-precision numbers with zero at once, as signed 16-bit integers, which have the same order.
# A NaN counts as positive, as in torch, unless its sign bit is set.
_CUDA = r"""
constexpr int A_PIECES = SLICE / 8, B_PIECES = TILE / 8;  // of a row
constexpr int ROW_STEP = THREADS / B_PIECES, OWN_ROWS = TILE / ROW_STEP;  // rows that a thread masks
extern __shared__ uint4 shared[];
const int tid = threadIdx.x, lane = tid & 31, warp = tid >> 5;
const int warp_row = (warp & 1) * 64, warp_column = (warp >> 1) * 64;

auto in_a = [](int row, int piece) { return row * A_PIECES + (piece ^ (row >> 1 & 3)); };
auto in_b = [](int row, int piece) { return row * B_PIECES + (piece ^ (row & 7)); };
auto address = [](const void* pointer) { return (unsigned)__cvta_generic_to_shared(pointer); };
#if __CUDA_ARCH__ >= 800
auto copy = [&](uint4* target, const wp::half* source, bool is_inside) {  // zeros from outside
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;"
        :: "r"(address(target)), "l"(source), "r"(is_inside ? 16 : 0));
};
auto commit = [] { asm volatile("cp.async.commit_group;"); };
auto wait = [] { asm volatile("cp.async.wait_group %0;" :: "n"(BUFFERS - 2)); };
auto multiply = [](float* c, const unsigned* a, const unsigned* b) {
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
        "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
};
#else
auto copy = [](uint4* target, const wp::half* source, bool is_inside) {
    *target = is_inside ? *(const uint4*)source : make_uint4(0, 0, 0, 0);
};
auto commit = [] {};
auto wait = [] {};
auto multiply = [](float* c, const unsigned* a, const unsigned* b) {
    for (int k = 0; k < 2; ++k)
        asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 "
            "{%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3]) : "r"(a[2 * k]), "r"(a[2 * k + 1]), "r"(b[k]));
};
#endif
auto buffer = [&](int slice) { return shared + slice % BUFFERS * 2 * TILE * A_PIECES; };
auto load = [&](int slice) {
    uint4* const a = buffer(slice);
    uint4* const b = a + TILE * A_PIECES;
    for (int i = 0; i < A_PIECES; ++i) {
        const int index = tid + i * THREADS;
        int row = index / A_PIECES, piece = index % A_PIECES, k = slice * SLICE + piece * 8;
        copy(a + in_a(row, piece), v_y.data + (long long)(first_row + row) * inner + k,
            first_row + row < rows && k < inner);
        row = index / B_PIECES, piece = index % B_PIECES, k = slice * SLICE + row;
        const int column = first_column + piece * 8;
        copy(b + in_b(row, piece), w.data + (long long)k * w.shape[1] + column, k < inner && column < columns);
    }
};

float acc[4][8][4] = {};  // products of 16 rows and 8 columns, of which a lane holds 4
const int num_slices = (inner + SLICE - 1) / SLICE;
for (int slice = 0; slice < BUFFERS - 1; ++slice) {
    if (slice < num_slices) load(slice);
    commit();
}
for (int slice = 0; slice < num_slices; ++slice) {
    wait();
    __syncthreads();
    if (slice + BUFFERS - 1 < num_slices) load(slice + BUFFERS - 1);
    commit();
    #pragma unroll
    for (int part = 0; part < SLICE / 16; ++part) {
        unsigned a[4][4], b[4][4];
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            const int position = in_a(warp_row + i * 16 + (lane & 15), part * 2 + (lane >> 4));
            asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                : "=r"(a[i][0]), "=r"(a[i][1]), "=r"(a[i][2]), "=r"(a[i][3])
                : "r"(address(buffer(slice) + position)));
        }
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            const int position = in_b(part * 16 + (lane & 15), warp_column / 8 + j * 2 + (lane >> 4));
            asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                : "=r"(b[j][0]), "=r"(b[j][1]), "=r"(b[j][2]), "=r"(b[j][3])
                : "r"(address(buffer(slice) + TILE * A_PIECES + position)));
        }
        #pragma unroll
        for (int i = 0; i < 4; ++i)
            #pragma unroll
            for (int j = 0; j < 8; ++j) multiply(acc[i][j], a[i], &b[j / 2][j % 2 * 2]);
    }
}

// From here on a thread processes one piece of every ROW_STEP-th row. Its features arrive while the products are
// written to shared memory.
const int first_own = tid / B_PIECES, piece = tid % B_PIECES, column = first_column + piece * 8;
auto is_inside = [&](int row) { return first_row + row < rows && column < columns; };
uint4 features[OWN_ROWS];
#pragma unroll
for (int i = 0; i < OWN_ROWS; ++i) {
    const int row = first_own + i * ROW_STEP;
    if (is_inside(row)) features[i] = *(const uint4*)(h.data + (long long)(first_row + row) * h.shape[1] + column);
}
__syncthreads();
#pragma unroll
for (int i = 0; i < 4; ++i)
    #pragma unroll
    for (int j = 0; j < 8; ++j)
        #pragma unroll
        for (int e = 0; e < 4; e += 2) {
            const unsigned low = wp::half(acc[i][j][e]).u, high = wp::half(acc[i][j][e + 1]).u;
            const int position = in_b(warp_row + i * 16 + e * 4 + (lane >> 2), warp_column / 8 + j);
            ((unsigned*)(shared + position))[lane & 3] = high << 16 | low;
        }
__syncthreads();
float column_sums[8] = {};
#pragma unroll
for (int i = 0; i < OWN_ROWS; ++i) {
    const int row = first_own + i * ROW_STEP;
    if (!is_inside(row)) continue;
    uint4 masked = shared[in_b(row, piece)];
    masked.x &= __vcmpgts2(features[i].x, 0u);
    masked.y &= __vcmpgts2(features[i].y, 0u);
    masked.z &= __vcmpgts2(features[i].z, 0u);
    masked.w &= __vcmpgts2(features[i].w, 0u);
    *(uint4*)(v_x.data + (long long)(first_row + row) * columns + column) = masked;
    for (int k = 0; k < 8; ++k) column_sums[k] += (float)((const wp::half*)&masked)[k];
}
__syncthreads();
float* const warp_sums = (float*)shared;
for (int k = 0; k < 8; ++k) {
    column_sums[k] += __shfl_xor_sync(0xffffffffu, column_sums[k], 16);  // the other row of this warp
    if (lane < 16) warp_sums[warp * TILE + piece * 8 + k] = column_sums[k];
}
__syncthreads();
if (first_column + tid < columns)
    sums.data[(long long)(tile / tiles_across) * columns + first_column + tid] =
        warp_sums[tid] + warp_sums[TILE + tid] + warp_sums[2 * TILE + tid] + warp_sums[3 * TILE + tid];
"""

_CPU = """
const int height = wp::min(rows - first_row, TILE), width = wp::min(columns - first_column, TILE);
const wp::half* const a = v_y.data + (long long)first_row * inner;
float acc[TILE][TILE] = {};
for (int k = 0; k < inner; ++k) {
    const wp::half* const b = w.data + (long long)k * w.shape[1] + first_column;
    float line[TILE];
    for (int column = 0; column < width; ++column) line[column] = (float)b[column];
    for (int row = 0; row < height; ++row) {
        const float factor = (float)a[(long long)row * inner + k];
        for (int column = 0; column < width; ++column) acc[row][column] += factor * line[column];
    }
}
for (int column = 0; column < width; ++column) {
    float column_sum = 0.0f;
    for (int row = 0; row < height; ++row) {
        const long long at = first_row + row;
        const wp::half feature = h.data[at * h.shape[1] + first_column + column];
        const wp::half masked = (short)feature.u > 0 ? wp::half(acc[row][column]) : wp::half(0.0f);
        v_x.data[at * columns + first_column + column] = masked;
        column_sum += (float)masked;
    }
    sums.data[(long long)(tile / tiles_across) * columns + first_column + column] = column_sum;
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
            # Makes Warp request dynamic shared memory, which the snippet uses. It must stay the only tile, because
            # ``shared`` is the start of that memory. On CPU Warp's memory of tiles is static: shards would share it.
            wp.tile_empty(shape=wp.static(2 * BUFFERS * TILE * SLICE), dtype=wp.float16, storage="shared")
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
