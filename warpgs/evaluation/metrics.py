"""Image quality: PSNR, SSIM, flicker; whole or within a region. LPIPS is in ``lpips``."""

import math

from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.ops.ssim import ssim_map


def psnr(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], region: Bool[Tensor, "H W"] | None = None
) -> float:
    """−10 log₁₀ of the mean squared error of images in [0, 1], within a region [dB].

    NaN if the region is empty, infinite if the images are equal there.
    """
    error = (image - truth).square().mean(-1)
    if region is not None:
        error = error[region]
    mean = error.double().mean().item()
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


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
    """mSSIM of DyCheck: pixels outside the region enter no window.

    Both images are set to zero outside, and the mean runs over the region's pixels; NaN if it is empty.
    """
    similarity = ssim_map(image.contiguous(), truth.contiguous(), region).mean(-1)
    return float(similarity[region].mean())


def flicker(
    before: Float[Tensor, "H W 3"],
    after: Float[Tensor, "H W 3"],
    region: Bool[Tensor, "H W"],
    truth_before: Float[Tensor, "H W 3"] | None = None,
    truth_after: Float[Tensor, "H W 3"] | None = None,
) -> float:
    """Mean absolute change between two consecutive frames of a fixed camera within a region.

    With the truth of both frames, only the change beyond the truth's counts: max(0, |Δ image| − |Δ truth|) per pixel
    and channel. NaN if the region is empty.
    """
    change = (after - before).abs()
    if truth_before is not None and truth_after is not None:
        change = (change - (truth_after - truth_before).abs()).clamp_min(0.0)
    return float(change.mean(-1)[region].mean())
