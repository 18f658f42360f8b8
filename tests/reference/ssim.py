"""Structural similarity in plain torch, any dtype: the full 11×11 window by convolution."""

import torch
from torch import Tensor
from torch.nn.functional import conv2d


def ssim_map(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """[H, W, C]."""
    if mask is not None:
        image, target = image * mask[..., None], target * mask[..., None]
    taps = torch.exp(-((torch.arange(11, dtype=image.dtype) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2

    def mean(values: Tensor) -> Tensor:
        return conv2d(values.permute(2, 0, 1)[:, None], window[None, None], padding=5)[:, 0].permute(1, 2, 0)

    mu_x, mu_y = mean(image), mean(target)
    var_x, var_y = mean(image * image) - mu_x**2, mean(target * target) - mu_y**2
    cov = mean(image * target) - mu_x * mu_y
    C1, C2 = 0.01**2, 0.03**2
    return (2 * mu_x * mu_y + C1) * (2 * cov + C2) / ((mu_x**2 + mu_y**2 + C1) * (var_x + var_y + C2))
