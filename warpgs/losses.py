"""The terms of the training loss (paper Eq. 9, 12, 14 and 15)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .ops.ssim import ssim


def image_loss(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], ssim_weight: float) -> Float[Tensor, ""]:
    """L1 + λ (1 − SSIM) over all pixels."""
    loss = (image - truth).abs().mean()
    return loss + ssim_weight * (1.0 - ssim(image.contiguous(), truth)) if ssim_weight else loss


def static_loss(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], static: Bool[Tensor, "H W"], ssim_weight: float
) -> Float[Tensor, ""]:
    """Paper Eq. 9: the static image against the truth, both masked by M, so that what is hidden stays free."""
    loss = ((image - truth) * static[..., None]).abs().mean()
    return loss + ssim_weight * (1.0 - ssim(image.contiguous(), truth, static)) if ssim_weight else loss


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


def depth_loss(
    depth: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"], target: Float[Tensor, "H W"], region: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Paper Eq. 14: L1 of one branch's depth against monocular depth within its region [scene units].

    Args:
        depth: Rendered, weighted by contribution and normalised.
        alpha: Opacity of the branch's image; pixels under half of it have no depth to speak of.
        target: Aligned monocular depth; NaN where unknown.
        region: M for the static branch.
    """
    known = region & target.isfinite() & (alpha > 0.5)
    error = torch.where(known, depth - torch.where(known, target, 0.0), 0.0).abs()
    return error.sum() / depth.numel()
