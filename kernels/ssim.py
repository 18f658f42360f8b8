"""Structural similarity (Wang et al. 2004) as 3DGS uses it: 11×11 Gaussian window, σ = 1.5, zero padding, per channel.

With x, y the two images (each times a mask, if there is one) and E[·] the windowed mean, μ_x = E[x], μ_y = E[y],
σ_x² = E[x²] - μ_x², σ_xy = E[xy] - μ_x μ_y:

    SSIM = (2 μ_x μ_y + C1)(2 σ_xy + C2) / ((μ_x² + μ_y² + C1)(σ_x² + σ_y² + C2)),  C1 = 0.01², C2 = 0.03².

Gradient with respect to x, with v the cotangent of the map and ∂ taken at fixed other moments:

    v_x = E[v ∂SSIM/∂μ_x] + 2 x E[v ∂SSIM/∂E[x²]] + y E[v ∂SSIM/∂E[xy]]        (the window is symmetric).

The window is separable. One thread slides down a strip of one column and channel: it filters each new line
horizontally, keeps the last eleven results, and filters those vertically, so a pixel costs 22 taps instead of 121 and
needs no shared memory. Images are [H, W, C], so neighbouring threads read neighbouring addresses.
"""

import math

import warp as wp

WINDOW = 11
RADIUS = 5
STRIP = wp.constant(32)
"""Pixels of one column that a thread handles; the lines above and below it are filtered again."""

C1 = wp.constant(0.01**2)
C2 = wp.constant(0.03**2)

window_vector = wp.types.vector(length=WINDOW, dtype=float)
_TAPS = [math.exp(-((k - RADIUS) ** 2) / (2.0 * 1.5**2)) for k in range(WINDOW)]
TAPS = wp.constant(window_vector(*[tap / sum(_TAPS) for tap in _TAPS]))


@wp.func
def pushed(history: window_vector, value: float) -> window_vector:
    """The history without its oldest value and with a new one at the end."""
    result = window_vector()
    for k in range(WINDOW - 1):
        result[k] = history[k + 1]
    result[WINDOW - 1] = value
    return result


@wp.func
def masked(image: wp.array3d[float], mask: wp.array2d[wp.uint8], y: int, x: int, c: int) -> float:
    """A pixel of an image inside its mask; zero outside. An empty mask array masks nothing."""
    if mask.shape[0] > 0:
        if mask[y, x] == wp.uint8(0):
            return 0.0
    return image[y, x, c]


@wp.kernel(enable_backward=False)
def ssim_fwd(
    first: int,
    image: wp.array3d[float],
    target: wp.array3d[float],
    mask: wp.array2d[wp.uint8],
    similarity: wp.array3d[float],
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
    top = (thread / lines) * STRIP
    bottom = wp.min(top + STRIP, height)
    h_x = window_vector()
    h_y = window_vector()
    h_xx = window_vector()
    h_yy = window_vector()
    h_xy = window_vector()
    for line in range(top - RADIUS, bottom + RADIUS):
        sum_x = float(0.0)
        sum_y = float(0.0)
        sum_xx = float(0.0)
        sum_yy = float(0.0)
        sum_xy = float(0.0)
        if line >= 0 and line < height:
            for k in range(WINDOW):
                column = x + k - RADIUS
                if column >= 0 and column < width:
                    p = masked(image, mask, line, column, c)
                    q = masked(target, mask, line, column, c)
                    tap = TAPS[k]
                    sum_x += tap * p
                    sum_y += tap * q
                    sum_xx += tap * p * p
                    sum_yy += tap * q * q
                    sum_xy += tap * p * q
        h_x = pushed(h_x, sum_x)
        h_y = pushed(h_y, sum_y)
        h_xx = pushed(h_xx, sum_xx)
        h_yy = pushed(h_yy, sum_yy)
        h_xy = pushed(h_xy, sum_xy)
        y = line - RADIUS
        if y >= top:
            mu_x = wp.dot(TAPS, h_x)
            mu_y = wp.dot(TAPS, h_y)
            luminance = mu_x * mu_x + mu_y * mu_y + C1
            # Rounding can leave a flat window's variance slightly negative; C2 keeps the quotient finite.
            contrast = wp.dot(TAPS, h_xx) - mu_x * mu_x + wp.dot(TAPS, h_yy) - mu_y * mu_y + C2
            cross_luminance = 2.0 * mu_x * mu_y + C1
            cross_contrast = 2.0 * (wp.dot(TAPS, h_xy) - mu_x * mu_y) + C2
            scale = 1.0 / (luminance * contrast)
            value = cross_luminance * cross_contrast * scale
            similarity[y, x, c] = value
            if partials.shape[0] > 0:
                partials[0, y, x, c] = (
                    2.0 * mu_y * (cross_contrast - cross_luminance) * scale
                    + 2.0 * mu_x * value / contrast
                    - 2.0 * mu_x * value / luminance
                )
                partials[1, y, x, c] = -value / contrast
                partials[2, y, x, c] = 2.0 * cross_luminance * scale


@wp.kernel(enable_backward=False)
def ssim_bwd(
    first: int,
    image: wp.array3d[float],
    target: wp.array3d[float],
    mask: wp.array2d[wp.uint8],
    partials: wp.array4d[float],
    v_similarity: wp.array3d[float],
    v_image: wp.array3d[float],
):
    thread = first + wp.tid()
    height = image.shape[0]
    width = image.shape[1]
    channels = image.shape[2]
    lines = width * channels
    x = (thread % lines) / channels
    c = thread % channels
    top = (thread / lines) * STRIP
    bottom = wp.min(top + STRIP, height)
    h_mean = window_vector()
    h_square = window_vector()
    h_cross = window_vector()
    for line in range(top - RADIUS, bottom + RADIUS):
        sum_mean = float(0.0)
        sum_square = float(0.0)
        sum_cross = float(0.0)
        if line >= 0 and line < height:
            for k in range(WINDOW):
                column = x + k - RADIUS
                if column >= 0 and column < width:
                    v = TAPS[k] * v_similarity[line, column, c]
                    sum_mean += v * partials[0, line, column, c]
                    sum_square += v * partials[1, line, column, c]
                    sum_cross += v * partials[2, line, column, c]
        h_mean = pushed(h_mean, sum_mean)
        h_square = pushed(h_square, sum_square)
        h_cross = pushed(h_cross, sum_cross)
        y = line - RADIUS
        if y >= top:
            p = masked(image, mask, y, x, c)
            q = masked(target, mask, y, x, c)
            v = wp.dot(TAPS, h_mean) + 2.0 * p * wp.dot(TAPS, h_square) + q * wp.dot(TAPS, h_cross)
            inside = int(1)
            if mask.shape[0] > 0:
                inside = int(mask[y, x])
            if inside == 0:
                v = 0.0
            v_image[y, x, c] = v
