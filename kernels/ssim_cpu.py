"""The kernels of ``ssim`` for the CPU, whose threads own blocks of neighbouring pixels: LLVM makes vector instructions
of a loop over all channels of the pixels of a line.

A thread slides down its block. It filters each new line horizontally, and keeps the results of the last lines, which
it then filters vertically. An image is [H, W C], so that neighbouring values of a channel are C apart.
"""

import functools

import warp as wp

from .absolute import abs_derivative
from .pixel_rows import make_read_row, make_write_row
from .ssim import C1, C2, RADIUS, TAPS, WINDOW

MAX_CHANNELS = 4
"""More would take a thread too much memory."""

PIXELS = 32
"""Width of a thread's block."""

STRIP = 64
"""Height of a thread's block; the lines above and below are filtered once more."""

KEPT = 16
"""Lines whose results a thread has room for: the power of two above ``WINDOW``."""


@functools.cache
def _make_read_wide(channels: int):
    """A function that reads a line of a block with the window's margin on both sides, zero outside the image."""
    margin = RADIUS * channels
    length = PIXELS * channels + 2 * margin
    vector = wp.types.vector(length, float)

    @wp.func_native(
        f"""
        wp::vec_t<{length}, float> row;
        const int size = image.shape[1], low = {margin} - begin, high = size - begin + {margin};
        const float* data = image.data + (size_t)line * size + begin - {margin};
        if (low <= 0 && high >= {length}) {{
            __builtin_memcpy(&row, data, sizeof(row));
        }} else {{
            for (int i = 0; i < {length}; ++i) row[i] = i >= low && i < high ? data[i] : 0.0f;
        }}
        return row;
        """
    )
    def read_wide(image: wp.array2d[float], line: int, begin: int) -> vector: ...

    return vector, read_wide


@wp.func
def block_of(thread: int, height: int, size: int, width: int) -> wp.vec4i:
    """First value of a line and number of values of a thread's block, and its first line and the one after its last."""
    blocks = (size + width - 1) / width
    begin = thread % blocks * width
    top = thread / blocks * STRIP
    return wp.vec4i(begin, wp.min(width, size - begin), top, wp.min(top + STRIP, height))


@functools.cache
def make_ssim_cpu_fwd(channels: int) -> wp.Kernel:
    """Forward kernel, one thread for each block; arguments as in ``make_ssim_fwd``, with lines of W C values."""
    B = PIXELS * channels
    wide, read_wide = _make_read_wide(channels)
    vector, write = make_write_row(B)
    ring = wp.types.vector(KEPT * 4 * B, float)

    @wp.kernel(enable_backward=False, module="unique", module_options={"optimization_level": 3})
    def ssim_cpu_fwd(
        first: int,
        image: wp.array2d[float],
        target: wp.array2d[float],
        base: float,
        l1: float,
        similarity: float,
        values: wp.array[float],
        d_mean: wp.array[float],
        d_square: wp.array[float],
        d_cross: wp.array[float],
    ):
        """The partial derivatives are not written where they are missing."""
        height = image.shape[0]
        size = image.shape[1]
        block = block_of(first + wp.tid(), height, size, wp.static(B))
        begin = block[0]
        count = block[1]
        top = block[2]
        bottom = block[3]
        squares = wide()
        cross = wide()
        kept = ring()
        value = vector()
        means = vector()
        square = vector()
        both = vector()
        for line in range(top - RADIUS, bottom + RADIUS):
            slot = (line & wp.static(KEPT - 1)) * wp.static(4 * B)
            if line >= 0 and line < height:
                p = read_wide(image, line, begin)
                q = read_wide(target, line, begin)
                for i in range(wp.static(B + 2 * RADIUS * channels)):
                    squares[i] = p[i] * p[i] + q[i] * q[i]
                    cross[i] = p[i] * q[i]
                for i in range(wp.static(B)):
                    sum_x = float(0.0)
                    sum_y = float(0.0)
                    sum_squares = float(0.0)
                    sum_xy = float(0.0)
                    for k in range(WINDOW):
                        sum_x += TAPS[k] * p[i + k * wp.static(channels)]
                        sum_y += TAPS[k] * q[i + k * wp.static(channels)]
                        sum_squares += TAPS[k] * squares[i + k * wp.static(channels)]
                        sum_xy += TAPS[k] * cross[i + k * wp.static(channels)]
                    kept[slot + i] = sum_x
                    kept[slot + i + wp.static(B)] = sum_y
                    kept[slot + i + wp.static(2 * B)] = sum_squares
                    kept[slot + i + wp.static(3 * B)] = sum_xy
            else:
                for i in range(wp.static(4 * B)):
                    kept[slot + i] = 0.0
            y = line - RADIUS
            if y >= top:
                p = read_wide(image, y, begin)
                q = read_wide(target, y, begin)
                for i in range(wp.static(B)):
                    mu_x = float(0.0)
                    mu_y = float(0.0)
                    mean_squares = float(0.0)
                    mean_xy = float(0.0)
                    for k in range(WINDOW):
                        own = ((y + k - RADIUS) & wp.static(KEPT - 1)) * wp.static(4 * B) + i
                        mu_x += TAPS[k] * kept[own]
                        mu_y += TAPS[k] * kept[own + wp.static(B)]
                        mean_squares += TAPS[k] * kept[own + wp.static(2 * B)]
                        mean_xy += TAPS[k] * kept[own + wp.static(3 * B)]
                    products = mu_x * mu_x + mu_y * mu_y
                    luminance = products + C1
                    contrast = mean_squares - products + C2
                    cross_luminance = 2.0 * mu_x * mu_y + C1
                    cross_contrast = 2.0 * (mean_xy - mu_x * mu_y) + C2
                    scale = 1.0 / (luminance * contrast)
                    s = cross_luminance * cross_contrast * scale
                    c = i + wp.static(RADIUS * channels)
                    value[i] = base + l1 * wp.abs(p[c] - q[c]) + similarity * s
                    slope = mu_y * (cross_contrast - cross_luminance) + mu_x * s * (luminance - contrast)
                    means[i] = 2.0 * scale * slope
                    square[i] = -s * luminance * scale
                    both[i] = 2.0 * cross_luminance * scale
                write(values, y * size + begin, count, value)
                if d_mean.shape[0] > 0:
                    write(d_mean, y * size + begin, count, means)
                    write(d_square, y * size + begin, count, square)
                    write(d_cross, y * size + begin, count, both)

    return ssim_cpu_fwd


@functools.cache
def make_ssim_cpu_bwd(channels: int) -> wp.Kernel:
    """Backward kernel, launched like the forward one."""
    B = PIXELS * channels
    _, read_wide = _make_read_wide(channels)
    vector, read = make_read_row(B)
    _, write = make_write_row(B)
    ring = wp.types.vector(KEPT * 3 * B, float)

    @wp.kernel(enable_backward=False, module="unique", module_options={"optimization_level": 3})
    def ssim_cpu_bwd(
        first: int,
        image: wp.array[float],
        target: wp.array[float],
        l1: float,
        similarity: float,
        d_mean: wp.array2d[float],
        d_square: wp.array2d[float],
        d_cross: wp.array2d[float],
        v_sum: wp.array[float],
        v_image: wp.array[float],
    ):
        height = d_mean.shape[0]
        size = d_mean.shape[1]
        block = block_of(first + wp.tid(), height, size, wp.static(B))
        begin = block[0]
        count = block[1]
        top = block[2]
        bottom = block[3]
        v = v_sum[0]
        kept = ring()
        value = vector()
        for line in range(top - RADIUS, bottom + RADIUS):
            slot = (line & wp.static(KEPT - 1)) * wp.static(3 * B)
            if line >= 0 and line < height:
                a = read_wide(d_mean, line, begin)
                b = read_wide(d_square, line, begin)
                c = read_wide(d_cross, line, begin)
                for i in range(wp.static(B)):
                    sum_a = float(0.0)
                    sum_b = float(0.0)
                    sum_c = float(0.0)
                    for k in range(WINDOW):
                        sum_a += TAPS[k] * a[i + k * wp.static(channels)]
                        sum_b += TAPS[k] * b[i + k * wp.static(channels)]
                        sum_c += TAPS[k] * c[i + k * wp.static(channels)]
                    kept[slot + i] = sum_a
                    kept[slot + i + wp.static(B)] = sum_b
                    kept[slot + i + wp.static(2 * B)] = sum_c
            else:
                for i in range(wp.static(3 * B)):
                    kept[slot + i] = 0.0
            y = line - RADIUS
            if y >= top:
                p = read(image, y * size + begin, count)
                q = read(target, y * size + begin, count)
                for i in range(wp.static(B)):
                    mean = float(0.0)
                    square = float(0.0)
                    both = float(0.0)
                    for k in range(WINDOW):
                        own = ((y + k - RADIUS) & wp.static(KEPT - 1)) * wp.static(3 * B) + i
                        mean += TAPS[k] * kept[own]
                        square += TAPS[k] * kept[own + wp.static(B)]
                        both += TAPS[k] * kept[own + wp.static(2 * B)]
                    slope = mean + 2.0 * p[i] * square + q[i] * both
                    value[i] = v * (l1 * abs_derivative(p[i] - q[i]) + similarity * slope)
                write(v_image, y * size + begin, count, value)

    return ssim_cpu_bwd
