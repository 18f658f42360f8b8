"""Structural similarity (Wang et al. 2004) as 3DGS uses it: 11×11 Gaussian window, σ = 1.5, zero padding, per channel;
alone, or in one pass with the absolute difference of the L1 loss.

With x, y the two images (each times a mask, if there is one) and E[·] the windowed mean, μ_x = E[x], μ_y = E[y],
σ_x² = E[x²] - μ_x², σ_xy = E[xy] - μ_x μ_y:

    SSIM = (2 μ_x μ_y + C1)(2 σ_xy + C2) / ((μ_x² + μ_y² + C1)(σ_x² + σ_y² + C2)),  C1 = 0.01², C2 = 0.03².

With three weights, the kernel writes for each pixel and channel

    value = base + l1 |x - y| + similarity SSIM.

Gradient with respect to x, where each ∂ holds the other windowed means fixed and v is the gradient of the sum of all
values:

    v_x = v (l1 sign(x - y) + similarity (E[∂SSIM/∂μ_x] + 2 x E[∂SSIM/∂E[x²]] + y E[∂SSIM/∂E[xy]])),

because the window is symmetric. If every pixel has its own gradient, the three ∂ are multiplied by it beforehand.

The window is separable. One thread slides down a strip of one column and channel: it filters each new line
horizontally and adds the result to the eleven lines that it reaches vertically, so that a pixel costs 22 taps instead
of 121 and no shared memory is needed. Images are [H, W, C], so neighbouring threads read neighbouring addresses.
"""

import functools
import math

import warp as wp

from .absolute import abs_derivative

WINDOW = 11
RADIUS = 5
BLOCK_DIM, MIN_BLOCKS = 128, 4
"""Threads of a CUDA block, and blocks per multiprocessor, so that a thread gets at most 128 registers. With as many as
the compiler likes, few threads would be there to hide the latency of loads."""

STRIP = 16
"""Pixels of one column per thread on CUDA; the lines above and below a strip are filtered once more."""

SMALL_IMAGE_STRIP = 6
"""``STRIP`` of small images on CUDA, which would otherwise have too few threads to keep a GPU busy."""

C1 = wp.constant(0.01**2)
C2 = wp.constant(0.03**2)

window_vector = wp.types.vector(length=WINDOW, dtype=float)
_TAPS = [math.exp(-((k - RADIUS) ** 2) / (2.0 * 1.5**2)) for k in range(WINDOW)]
TAPS = wp.constant(window_vector(*[tap / sum(_TAPS) for tap in _TAPS]))


@wp.func
def shift_and_add(pending: window_vector, value: float) -> window_vector:
    """The eleven pending outputs of the vertical filter after one more line, which completes element 0.

    Element j belongs to the line j - RADIUS below the new one, where the new line has tap 2 RADIUS - j. Shifting and
    adding are one multiply-add, so that no ring buffer is needed.
    """
    result = window_vector()
    for j in range(WINDOW - 1):
        result[j] = pending[j + 1] + TAPS[WINDOW - 1 - j] * value
    result[WINDOW - 1] = TAPS[0] * value
    return result


# Pixels outside the image read their nearest neighbour and are then set to zero: without a branch, all loads of a
# window can be in flight at once.
@wp.func
def sample(image: wp.array3d[float], mask: wp.array2d[wp.uint8], y: int, x: int, c: int) -> float:
    """A pixel; zero outside the image's columns."""
    value = image[y, wp.clamp(x, 0, image.shape[1] - 1), c]
    return wp.where(x >= 0 and x < image.shape[1], value, 0.0)


@wp.func
def sample_masked(image: wp.array3d[float], mask: wp.array2d[wp.uint8], y: int, x: int, c: int) -> float:
    """A pixel; zero outside the image's columns and where the mask is zero."""
    inside = wp.clamp(x, 0, image.shape[1] - 1)
    value = image[y, inside, c]
    return wp.where(x == inside and mask[y, inside] != wp.uint8(0), value, 0.0)


@functools.cache
def make_ssim_fwd(with_mask: bool) -> wp.Kernel:
    """Forward kernel, one thread for each strip, column and channel."""
    pixel = sample_masked if with_mask else sample

    @wp.kernel(enable_backward=False, launch_bounds=(BLOCK_DIM, MIN_BLOCKS), module="unique")
    def ssim_fwd(
        first: int,
        image: wp.array3d[float],
        target: wp.array3d[float],
        mask: wp.array2d[wp.uint8],
        strip: int,
        base: float,
        l1: float,
        similarity: float,
        values: wp.array3d[float],
        partials: wp.array4d[float],
    ):
        """``partials`` [3, H, W, C]: ∂SSIM/∂μ_x, ∂SSIM/∂E[x²], ∂SSIM/∂E[xy]; not written where its first size is 0."""
        thread = first + wp.tid()
        height = image.shape[0]
        width = image.shape[1]
        channels = image.shape[2]
        lines = width * channels
        x = (thread % lines) / channels
        c = thread % channels
        top = (thread / lines) * strip
        bottom = wp.min(top + strip, height)
        pending_x = window_vector()
        pending_y = window_vector()
        pending_squares = window_vector()
        pending_xy = window_vector()
        for line in range(top - RADIUS, bottom + RADIUS):
            sum_x = float(0.0)
            sum_y = float(0.0)
            sum_squares = float(0.0)
            sum_xy = float(0.0)
            if line >= 0 and line < height:
                for k in range(WINDOW):
                    p = pixel(image, mask, line, x + k - RADIUS, c)
                    q = pixel(target, mask, line, x + k - RADIUS, c)
                    tap = TAPS[k]
                    sum_x += tap * p
                    sum_y += tap * q
                    sum_squares += tap * (p * p + q * q)
                    sum_xy += tap * p * q
            pending_x = shift_and_add(pending_x, sum_x)
            pending_y = shift_and_add(pending_y, sum_y)
            pending_squares = shift_and_add(pending_squares, sum_squares)
            pending_xy = shift_and_add(pending_xy, sum_xy)
            y = line - RADIUS
            if y >= top:
                mu_x = pending_x[0]
                mu_y = pending_y[0]
                products = mu_x * mu_x + mu_y * mu_y
                luminance = products + C1
                # Rounding can make the variance of a flat window slightly negative; C2 keeps the quotient finite.
                contrast = pending_squares[0] - products + C2
                cross_luminance = 2.0 * mu_x * mu_y + C1
                cross_contrast = 2.0 * (pending_xy[0] - mu_x * mu_y) + C2
                scale = 1.0 / (luminance * contrast)
                value = cross_luminance * cross_contrast * scale
                difference = pixel(image, mask, y, x, c) - pixel(target, mask, y, x, c)
                values[y, x, c] = base + l1 * wp.abs(difference) + similarity * value
                if partials.shape[0] > 0:
                    partials[0, y, x, c] = (
                        2.0 * mu_y * (cross_contrast - cross_luminance) * scale
                        + 2.0 * mu_x * value / contrast
                        - 2.0 * mu_x * value / luminance
                    )
                    partials[1, y, x, c] = -value / contrast
                    partials[2, y, x, c] = 2.0 * cross_luminance * scale

    return ssim_fwd


@functools.cache
def make_ssim_bwd(with_mask: bool) -> wp.Kernel:
    """Backward kernel, launched like the forward one."""
    pixel = sample_masked if with_mask else sample

    @wp.kernel(enable_backward=False, launch_bounds=(BLOCK_DIM, MIN_BLOCKS), module="unique")
    def ssim_bwd(
        first: int,
        image: wp.array3d[float],
        target: wp.array3d[float],
        mask: wp.array2d[wp.uint8],
        strip: int,
        l1: float,
        similarity: float,
        partials: wp.array4d[float],
        v_sum: wp.array[float],
        v_image: wp.array3d[float],
    ):
        """``v_sum`` [1]: gradient of the sum of all values."""
        thread = first + wp.tid()
        height = image.shape[0]
        width = image.shape[1]
        channels = image.shape[2]
        lines = width * channels
        x = (thread % lines) / channels
        c = thread % channels
        top = (thread / lines) * strip
        bottom = wp.min(top + strip, height)
        pending_mean = window_vector()
        pending_square = window_vector()
        pending_cross = window_vector()
        for line in range(top - RADIUS, bottom + RADIUS):
            sum_mean = float(0.0)
            sum_square = float(0.0)
            sum_cross = float(0.0)
            if line >= 0 and line < height:
                for k in range(WINDOW):
                    column = wp.clamp(x + k - RADIUS, 0, width - 1)
                    tap = wp.where(column == x + k - RADIUS, TAPS[k], 0.0)
                    sum_mean += tap * partials[0, line, column, c]
                    sum_square += tap * partials[1, line, column, c]
                    sum_cross += tap * partials[2, line, column, c]
            pending_mean = shift_and_add(pending_mean, sum_mean)
            pending_square = shift_and_add(pending_square, sum_square)
            pending_cross = shift_and_add(pending_cross, sum_cross)
            y = line - RADIUS
            if y >= top:
                p = pixel(image, mask, y, x, c)
                q = pixel(target, mask, y, x, c)
                slope = pending_mean[0] + 2.0 * p * pending_square[0] + q * pending_cross[0]
                value = v_sum[0] * (l1 * abs_derivative(p - q) + similarity * slope)
                if wp.static(with_mask):
                    if mask[y, x] == wp.uint8(0):
                        value = 0.0
                v_image[y, x, c] = value

    return ssim_bwd
