"""Structural similarity on CPU, by the kernels of kernels/ssim_cpu.py."""

from typing import Any

import cv2
import torch
from torch import Tensor

from warpgs.kernels import ssim_cpu as kernels
from warpgs.runtime.launch import launch


def has_kernel(image: Tensor) -> bool:
    """Whether the kernels of the CPU compare an image [H, W, C]; otherwise those of CUDA do."""
    return not image.is_cuda and image.numel() > 0 and image.shape[2] <= kernels.MAX_CHANNELS


def ssim_fwd(
    image: Tensor, target: Tensor, mask: Tensor | None, weights: tuple[float, float, float], with_partials: bool
) -> tuple[Tensor, Tensor]:
    """The forward pass; arguments and results are those of ``ssim.ssim_fwd``."""
    values = torch.empty_like(image)
    partials = image.new_empty(3 if with_partials else 0, *image.shape)
    inputs = _lines(_masked(image, mask)), _lines(_masked(target, mask))
    written = (None, None, None) if partials.numel() == 0 else tuple(part.view(-1) for part in partials)
    _launch(kernels.make_ssim_cpu_fwd(image.shape[2]), image, *inputs, *weights, values.view(-1), *written)
    return values, partials


def ssim_bwd(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    weights: tuple[float, float, float],
    partials: Tensor,
    v_sum: Tensor,
) -> Tensor:
    """The backward pass; arguments and result are those of ``ssim.ssim_bwd``."""
    v_image = torch.empty_like(image)
    inputs = _masked(image, mask).view(-1), _masked(target, mask).view(-1)
    lines = tuple(_lines(part) for part in partials)
    kernel = kernels.make_ssim_cpu_bwd(image.shape[2])
    _launch(kernel, image, *inputs, *weights[1:], *lines, v_sum, v_image.view(-1))
    return _masked(v_image, mask)


def _launch(kernel: Any, image: Tensor, *arguments: Any) -> None:
    H, W, C = image.shape
    blocks = -(-H // kernels.STRIP) * -(-W // kernels.PIXELS)
    launch(kernel, blocks, *arguments, work=kernels.STRIP * kernels.PIXELS * C)


def _lines(image: Tensor) -> Tensor:
    return image.view(len(image), -1)


def _masked(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image, zero where the mask is zero, whatever the image has there."""
    if mask is None:
        return image.detach()
    return torch.from_numpy(cv2.copyTo(image.detach().numpy(), mask.view(torch.uint8).numpy())).view(image.shape)
