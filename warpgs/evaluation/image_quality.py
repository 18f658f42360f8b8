"""Image quality: PSNR, SSIM, MS-SSIM, flicker; whole or within a region. LPIPS is in ``lpips``."""

import math

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn import functional as F

from warpgs.ops.ssim import ssim_map

WINDOW, SIGMA = 11, 1.5
"""Side of the Gaussian window of SSIM, and its standard deviation [px]."""

C1, C2 = 0.01**2, 0.03**2
"""The constants of SSIM for values in [0, 1]."""

MIN_SQUARED_ERROR = 1.0 / (12.0 * 255.0**2)
"""Variance of the rounding error of a ground truth of 8 bits: smaller errors cannot be measured with it. So PSNR is at
most 58.9 dB, also where an image has no error at all, as white does in front of a white background."""

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the scales of MS-SSIM (Wang et al. 2003), from the finest on."""

MIN_MS_SSIM_SIDE = (WINDOW - 1) * 2 ** (len(SCALE_WEIGHTS) - 1) + 1
"""Minimum side of images for MS-SSIM: a window must fit into the coarsest scale [px]."""


def psnr(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], region: Bool[Tensor, "H W"] | None = None
) -> float:
    """−10 log₁₀ of the mean squared error of images in [0, 1], within a region [dB]; at most 58.9 (see above).

    NaN if the region is empty.
    """
    error = (image - truth).square().mean(-1)
    if region is not None:
        error = error[region]
    mean = error.double().mean().item()
    return -10.0 * math.log10(max(mean, MIN_SQUARED_ERROR))


def ssim(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], region: Bool[Tensor, "H W"] | None = None
) -> float:
    """Mean structural similarity, 11×11 Gaussian window of σ = 1.5 and zero padding as in 3DGS.

    Within a region, the mean of the map over its pixels, whose windows may reach outside; NaN if it is empty.
    """
    similarity = ssim_map(image.contiguous(), truth.contiguous()).mean(-1)
    if region is not None:
        similarity = similarity[region]
    return float(similarity.mean())


def masked_ssim(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], region: Bool[Tensor, "H W"]) -> float:
    """mSSIM as DyCheck defines it (Gao et al. 2022): the window is a partial convolution over the region.

    The mean of a window is taken over its pixels in the region, first along rows, then along columns; no padding. The
    mean over windows includes those without any pixel of the region, which count as 1.

    NaN if the region is empty, or the images are smaller than the window.
    """
    if not bool(region.any()) or min(region.shape) < WINDOW:
        return math.nan
    a, b = (x.double().permute(2, 0, 1)[:, None] for x in (image, truth))
    moments, mask = torch.cat([a, b, a * a, b * b, a * b]), region.double()[None, None]
    window = _window(moments)
    for kernel in (window.view(1, 1, 1, -1), window.view(1, 1, -1, 1)):
        known = F.conv2d(mask, torch.ones_like(kernel))
        filtered = F.conv2d(moments * mask, kernel) * (WINDOW / known.clamp_min(1.0))
        moments, mask = torch.where(known > 0, filtered, 0.0), (known > 0).double()
    mean_a, mean_b, square_a, square_b, product = moments.chunk(5)
    variance_a, variance_b = (square_a - mean_a**2).clamp_min(0.0), (square_b - mean_b**2).clamp_min(0.0)
    bound = (variance_a * variance_b).sqrt()
    covariance = (product - mean_a * mean_b).clamp(-bound, bound)
    luminance = (2.0 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return float((luminance * (2.0 * covariance + C2) / (variance_a + variance_b + C2)).mean())


def ms_ssim(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float:
    """Multi-scale SSIM (Wang et al. 2003), as TensorFlow's ``ssim_multiscale``, which HyperNeRF uses.

    NaN if a side of the images is smaller than ``MIN_MS_SSIM_SIDE``.
    """
    if min(image.shape[:2]) < MIN_MS_SSIM_SIDE:
        return math.nan
    a, b = (x.double().permute(2, 0, 1)[:, None] for x in (image, truth))
    window = _window(a)
    result = torch.ones(3, dtype=torch.float64, device=a.device)
    for k, weight in enumerate(SCALE_WEIGHTS):
        if k > 0:
            a, b = (F.avg_pool2d(F.pad(x, (0, x.shape[3] % 2, 0, x.shape[2] % 2), "replicate"), 2) for x in (a, b))
        moments = F.conv2d(torch.cat([a, b, a * a + b * b, a * b]), window.view(1, 1, 1, -1))
        mean_a, mean_b, squares, product = F.conv2d(moments, window.view(1, 1, -1, 1)).chunk(4)
        similarity = (2.0 * (product - mean_a * mean_b) + C2) / (squares - mean_a**2 - mean_b**2 + C2)
        if k == len(SCALE_WEIGHTS) - 1:
            similarity = similarity * (2.0 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
        result = result * similarity.mean((1, 2, 3)).clamp_min(0.0) ** weight
    return float(result.mean())


def _window(like: Float64[Tensor, "..."]) -> Float64[Tensor, " WINDOW"]:
    """The Gaussian window along one axis, on a tensor's device."""
    offsets = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    weights = (-0.5 * (offsets / SIGMA) ** 2).exp()
    return weights / weights.sum()


def flicker(before: Float[Tensor, "H W 3"], after: Float[Tensor, "H W 3"], region: Bool[Tensor, "H W"]) -> float:
    """Mean absolute change between two consecutive frames of a fixed camera within a region; NaN if it is empty."""
    return float((after - before).abs().mean(-1)[region].mean())
