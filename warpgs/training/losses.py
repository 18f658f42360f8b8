"""The image terms of the training loss (paper Eq. 9, 12 and 15); that of depth (Eq. 14) is ``ops.depth_error``."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.ops.ssim import l1_and_ssim


def image_loss(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], ssim_weight: float) -> Float[Tensor, ""]:
    """L1 + λ (1 − SSIM) over all pixels."""
    if ssim_weight:
        return l1_and_ssim(image.contiguous(), truth, ssim_weight)
    return (image - truth).abs().mean()


def static_loss(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], static: Bool[Tensor, "H W"], ssim_weight: float
) -> Float[Tensor, ""]:
    """Paper Eq. 9: the static image against the truth, both masked by M, so that what is hidden stays free."""
    if ssim_weight:
        return l1_and_ssim(image.contiguous(), truth, ssim_weight, static)
    return ((image - truth) * static[..., None]).abs().mean()


def dynamic_loss(
    image: Float[Tensor, "H W 3"],
    truth: Float[Tensor, "H W 3"],
    static: Bool[Tensor, "H W"],
    ssim_weight: float,
    background: Float[Tensor, "3"],
) -> Float[Tensor, ""]:
    """Paper Eq. 12: the dynamic image, rendered over ``background``, against the truth masked by 1 − M.

    Only the truth is masked: where M = 1 the dynamic image has to show its background.
    """
    return image_loss(image, torch.where(static[..., None], background, truth), ssim_weight)
