"""Structural similarity on CPU: the formulas of kernels/ssim.py, with OpenCV's separable filter as windowed mean.

The filter is vectorized, the loop over the window in a kernel is not.
"""

import cv2
import torch
from torch import Tensor

from warpgs.kernels import ssim as kernels
from warpgs.runtime.launch import on_all_cores
from warpgs.runtime.profiling import span

MAX_CHANNELS = 128
"""OpenCV's limit."""

TAPS = torch.tensor(list(kernels.TAPS), dtype=torch.float32).numpy()


def can_filter(image: Tensor) -> bool:
    """Whether OpenCV can filter an image [H, W, C]; otherwise the kernels compare it."""
    return not image.is_cuda and image.numel() > 0 and image.shape[2] <= MAX_CHANNELS


def ssim_fwd(
    image: Tensor, target: Tensor, mask: Tensor | None, weights: tuple[float, float, float], with_partials: bool
) -> tuple[Tensor, Tensor]:
    """The forward pass; arguments and results are those of ``ssim.ssim_fwd``."""
    with span("ssim_fwd", image):
        base, l1, similarity_weight = weights
        x, y = _masked(image, mask), _masked(target, mask)
        # The variances of both images are only needed as a sum.
        mu_x, mu_y, squares, cross = _windowed_means(x, y, (x * x).addcmul_(y, y), x * y)
        luminance = (mu_x * mu_x).addcmul_(mu_y, mu_y)
        contrast = squares.sub_(luminance).add_(kernels.C2)
        luminance.add_(kernels.C1)
        product = mu_x * mu_y
        cross_contrast = cross.sub_(product).mul_(2.0).add_(kernels.C2)
        cross_luminance = product.mul_(2.0).add_(kernels.C1)
        scale = (luminance * contrast).reciprocal_()
        similarity = (cross_luminance * cross_contrast).mul_(scale)
        values = similarity * similarity_weight
        if l1:
            values.add_((x - y).abs_(), alpha=l1)
        partials = image.new_empty(3 if with_partials else 0, *image.shape)
        if with_partials:
            d_mean, d_square, d_cross = partials
            torch.mul(cross_luminance, scale, out=d_cross).mul_(2.0)
            torch.mul(similarity, luminance, out=d_square).mul_(scale).neg_()
            torch.sub(cross_contrast, cross_luminance, out=d_mean).mul_(mu_y)
            d_mean.addcmul_(similarity.mul_(mu_x), luminance.sub_(contrast)).mul_(scale).mul_(2.0)
        return values.add_(base), partials


def ssim_bwd(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    weights: tuple[float, float, float],
    partials: Tensor,
    v_sum: Tensor,
) -> Tensor:
    """The backward pass; arguments and result are those of ``ssim.ssim_bwd``."""
    with span("ssim_bwd", image):
        _, l1, similarity_weight = weights
        x, y = _masked(image, mask), _masked(target, mask)
        mean, square, cross = _windowed_means(*partials)
        v_image = mean.addcmul_(x, square, value=2.0).addcmul_(y, cross).mul_(similarity_weight)
        if l1:
            v_image.add_((x - y).sign_(), alpha=l1)
        return _masked(v_image.mul_(v_sum), mask)


def _masked(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image, zero where the mask is zero, whatever the image has there."""
    if mask is None:
        return image.detach()
    return torch.from_numpy(cv2.copyTo(image.detach().numpy(), mask.view(torch.uint8).numpy())).view(image.shape)


def _windowed_means(*maps: Tensor) -> list[Tensor]:
    """The windowed means of [H, W, C] maps, with zeros outside of the image."""
    means = [torch.empty_like(values) for values in maps]

    def filter_map(index: int) -> None:
        source, result = maps[index].numpy(), means[index].numpy()
        cv2.sepFilter2D(source, cv2.CV_32F, TAPS, TAPS, dst=result, borderType=cv2.BORDER_CONSTANT)

    on_all_cores(filter_map, len(maps))
    return means
