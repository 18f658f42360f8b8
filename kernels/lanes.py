"""Lane groups: one kernel source that is fast on CUDA and correct on CPU.

On CUDA a lane group is a warp: 32 lanes laid out as 8 by 4, which vote, shuffle and share a small staging buffer in
shared memory. On CPU a group is one lane: votes and sums are the identity, and the staging buffer returns the lane's
own value. A kernel launches ``lane_count()`` threads for each group, in blocks of ``BLOCK_DIM`` threads.
"""

import warp as wp

WARP_SIZE = 32
"""Lanes of a group on CUDA."""

WARP_COLUMNS, WARP_ROWS = 8, 4
"""Layout of the lanes of a group on CUDA."""

BLOCK_DIM = 128
"""Threads of a CUDA block in every kernel that uses the staging buffer, whose size depends on it."""


def native(cuda: str, cpu: str) -> str:
    """A native snippet with separate code for CUDA and CPU."""
    return f"\n#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"


def warp_reduce(intrinsic: str, combine: str) -> str:
    """CUDA code that combines ``x`` of all lanes and returns the result; ``combine`` is an expression of x and other.

    The intrinsic needs compute capability 8.0.
    """
    return f"""
        #if __CUDA_ARCH__ >= 800
        return {intrinsic}(0xffffffffu, x);
        #else
        for (int o = 16; o > 0; o >>= 1) {{
            const auto other = __shfl_xor_sync(0xffffffffu, x, o);
            x = {combine};
        }}
        return x;
        #endif
        """


def warp_prefix_sum(value_type: str, name: str) -> str:
    """CUDA code that turns a variable of each lane into its inclusive prefix sum over the warp; it reads ``lane``."""
    return f"""
        for (int o = 1; o < 32; o <<= 1) {{
            const {value_type} below = __shfl_up_sync(0xffffffffu, {name}, o);
            if (lane >= o) {name} += below;
        }}
        """


@wp.func_native(native("return 32;", "return 1;"))
def lane_count() -> int: ...


@wp.func_native(native("return 8;", "return 1;"))
def lane_columns() -> int: ...


@wp.func_native(native("return 4;", "return 1;"))
def lane_rows() -> int: ...


@wp.func_native(native("return __ballot_sync(0xffffffffu, x != 0);", "return x != 0 ? 1u : 0u;"))
def lane_ballot(x: int) -> wp.uint32:
    """Bit j is set where lane j holds a nonzero ``x``."""
    ...


@wp.func_native(native("return __any_sync(0xffffffffu, x != 0);", "return x != 0;"))
def lane_any(x: int) -> int: ...


@wp.func_native(native(warp_reduce("__reduce_max_sync", "other > x ? other : x"), "return x;"))
def lane_max(x: int) -> int: ...


@wp.func_native(native(warp_reduce("__reduce_or_sync", "x | other"), "return x;"))
def lane_or(x: int) -> int: ...


@wp.func_native(
    native("for (int o = 16; o > 0; o >>= 1) x += __shfl_xor_sync(0xffffffffu, x, o); return x;", "return x;")
)
def lane_sum(x: float) -> float: ...


@wp.func_native(native("return __popc(mask);", "return (int)mask;"))
def lane_bit_count(mask: wp.uint32) -> int:
    """Number of bits that are set in a ballot."""
    ...


@wp.func_native(native("return __popc(mask & ((1u << lane) - 1u));", "return 0;"))
def lane_rank(mask: wp.uint32, lane: int) -> int:
    """Number of lanes below ``lane`` whose bit is set in a ballot."""
    ...


@wp.func_native(native("return __ffs(mask) - 1;", "return 0;"))
def lane_lowest(mask: wp.uint32) -> int:
    """Lowest lane whose bit is set in a ballot that is not zero."""
    ...


@wp.func_native(native("return __shfl_sync(0xffffffffu, x, lane);", "return x;"))
def lane_broadcast(x: int, lane: int) -> int:
    """The value of ``x`` in lane ``lane``."""
    ...


@wp.func_native(native(f"int sum = x; {warp_prefix_sum('int', 'sum')} return sum - x;", "return 0;"))
def lane_sum_before(x: int, lane: int) -> int:
    """Sum of ``x`` over the lanes below ``lane``."""
    ...


@wp.func_native(native("__syncwarp();", ""))
def lane_sync(): ...


# The staging buffer: 32 slots of three vec4 for each of the four lane groups of a block, in shared memory. Its address
# is passed around as an integer because a shared array is only visible in the function that declares it.
@wp.func_native(
    native(
        "__shared__ float4 stage[4 * 32 * 3]; return (unsigned long long)(stage + (threadIdx.x >> 5) * 96);",
        "return 0;",
    )
)
def stage_address() -> wp.uint64: ...


@wp.func_native(native("((float4*)stage)[slot * 3 + part] = make_float4(value[0], value[1], value[2], value[3]);", ""))
def stage_put(stage: wp.uint64, slot: int, part: int, value: wp.vec4): ...


@wp.func_native(
    native(
        "const float4 v = ((const float4*)stage)[slot * 3 + part]; return wp::vec4(v.x, v.y, v.z, v.w);", "return own;"
    )
)
def stage_get(stage: wp.uint64, slot: int, part: int, own: wp.vec4) -> wp.vec4:
    """The value that a lane put into ``slot``; on CPU, with its single lane, ``own``."""
    ...


# Loops over a lane's own pixels: on CPU, where the single lane owns a whole tile, the loop is restricted to the span
# that a Gaussian covers; on CUDA the bounds are constants, so that the loop unrolls into registers.
@wp.func_native(native("return 0;", "return low <= 0.0f ? 0 : (low >= (float)size ? size : (int)ceilf(low));"))
def span_begin(low: float, size: int) -> int:
    """First index of [0, size) that is at least ``low``; on CUDA always 0."""
    ...


@wp.func_native(native("return size;", "return high < 0.0f ? 0 : (high >= (float)(size - 1) ? size : (int)high + 1);"))
def span_end(high: float, size: int) -> int:
    """One past the last index of [0, size) that is at most ``high``; on CUDA always ``size``."""
    ...


# On CPU the Taylor series of 2^f for f in [-½, ½], to single precision: LLVM vectorizes no call of exp2f.
@wp.func_native(
    native(
        "return exp2f(x);",
        """
        const float bounded = x > -126.0f ? x : -126.0f;
        const float whole = rintf(bounded);
        const float f = bounded - whole;
        const float p = 1.0f + f * (0.693147180559945f + f * (0.240226506959101f + f * (0.0555041086648216f
                      + f * (0.00961812910762848f + f * (0.00133335581464284f + f * 0.000154035303933816f)))));
        const int bits = ((int)whole + 127) << 23;
        float power;
        __builtin_memcpy(&power, &bits, 4);
        return p * power;
        """,
    )
)
def exp2(x: float) -> float: ...


def _add_columns(length: int, columns: int) -> str:
    """C++ code that adds ``length`` values, each given as ``columns`` parts, to ``target[row]``.

    A vector has the parts of one value first. Each step adds the upper half of the parts to the lower half, and joins
    the halves of two neighbouring vectors: as many shuffles as vectors, instead of as many for each value.
    """
    code = f"""
        typedef float V __attribute__((vector_size({4 * columns})));
        float* total = &wp::index(target, row, 0);
        V v[{length}];
        __builtin_memcpy(v, &values, sizeof(v));
        """
    vectors, half = length, columns // 2
    while half > 0:
        lower = [i for i in range(2 * columns) if i // half % 2 == 0]
        low, high = (", ".join(str(i + shift) for i in lower) for shift in (0, half))
        for k in range(0, vectors, 2):
            pair = f"v[{k}], v[{min(k + 1, vectors - 1)}]"
            code += f"v[{k // 2}] = __builtin_shufflevector({pair}, {low}) + __builtin_shufflevector({pair}, {high});\n"
        vectors, half = (vectors + 1) // 2, half // 2
    return code + f"for (int k = 0; k < {length}; ++k) total[k] += v[k / {columns}][k % {columns}];"


# Sums of K values over 32 lanes with little more than one shuffle per value instead of five: in each of the five steps
# a lane sends the half of its values that its partner keeps, so that each lane ends with K/32 totals, which are
# adjacent: the totals [index, index + held).
def make_lane_add(length: int, columns: int = 1):
    """A vector type of ``length`` floats and a function ``lane_add(values, target, row)`` that adds the lane group's
    sum of each value to ``target[row]``, which is a row of contiguous floats.

    On CPU, each value may be given as ``columns`` consecutive parts, a power of two.
    """
    values_type = wp.types.vector(length=length * columns, dtype=float)

    @wp.func_native(
        native(
            """
            constexpr int K = sizeof(values) / sizeof(float);
            float v[K + 1];
            #pragma unroll
            for (int k = 0; k < K; ++k) v[k] = values[k];
            const int lane = threadIdx.x & 31;
            int index = 0, held = K, n = K;
            #pragma unroll
            for (int o = 16; o > 0; o >>= 1) {
                const int h = (n + 1) / 2;
                const bool up = (lane & o) != 0;
                #pragma unroll
                for (int k = 0; k < (K + 1) / 2; ++k) {
                    if (k < h) {
                        const float high = h + k < n ? v[h + k] : 0.0f;
                        const float sent = up ? v[k] : high;
                        const float kept = up ? high : v[k];
                        v[k] = kept + __shfl_xor_sync(0xffffffffu, sent, o);
                    }
                }
                index += up ? h : 0;
                held = up ? held - h : min(held, h);
                n = h;
            }
            float* total = &wp::index(target, row, 0) + index;
            #pragma unroll
            for (int k = 0; k < (K + 31) / 32; ++k)
                if (k < held) atomicAdd(total + k, v[k]);
            """,
            _add_columns(length, columns),
        )
    )
    def lane_add(values: values_type, target: wp.array2d[float], row: int): ...

    return values_type, lane_add
