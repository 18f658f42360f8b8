"""Structural similarity (SSIM), alone or together with the L1 loss.

On CUDA by two kernels (kernels/ssim.py, where the formulas are), on CPU by those of kernels/ssim_cpu.py.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import ssim as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import is_small, launch
from warpgs.runtime.tape import Gradients, Recorded, differentiable

from . import ssim_cpu


class Weights(NamedTuple):
    """Weights of ``base + l1 |image − target| + similarity SSIM``."""

    base: float
    l1: float
    similarity: float


SIMILARITY = Weights(0.0, 0.0, 1.0)
"""SSIM alone."""


def ssim_map(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W C"]:
    """[H, W, C] SSIM around each pixel and channel; see ``ssim``."""
    return _compare(image, target, mask, SIMILARITY, mean=False)


def ssim(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Mean SSIM over pixels and channels; differentiable in ``image`` only.

    Wang et al. 2004 with an 11×11 Gaussian window of σ = 1.5 and zero padding, as in 3DGS, for values in [0, 1].

    Args:
        image: [H, W, C] rendered image.
        target: [H, W, C] ground truth; gets no gradient.
        mask: [H, W] where it is false, both images are treated as zero (paper Eq. 9). The mean is still taken over the
            whole image.

    Raises:
        ValueError: On a wrong shape, dtype or device, or an image without pixels.
    """
    return _compare(image, target, mask, SIMILARITY, mean=True)


def l1_and_ssim(
    image: Float[Tensor, "H W C"],
    target: Float[Tensor, "H W C"],
    ssim_weight: float,
    mask: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, ""]:
    """Mean of |image − target| + λ (1 − SSIM) over pixels and channels, in one pass; see ``ssim``.

    Args:
        ssim_weight: λ.
    """
    return _compare(image, target, mask, Weights(ssim_weight, 1.0, -ssim_weight), mean=True)


def _compare(image: Tensor, target: Tensor, mask: Tensor | None, weights: Weights, mean: bool) -> Tensor:
    """base + l1 |image − target| + similarity SSIM: the mean, or without L1 the [H, W, C] values."""
    assert mean or weights == SIMILARITY
    _check_inputs(image, target, mask, mean)
    on_cpu = ssim_cpu.has_kernel(image)
    forward, backward = (ssim_cpu.ssim_fwd, ssim_cpu.ssim_bwd) if on_cpu else (ssim_fwd, ssim_bwd)

    def op(image: Tensor, target: Tensor) -> Recorded:
        values, partials = forward(image, target, mask, weights, image.requires_grad)
        return Recorded((values.mean() if mean else values,), op_backward, (image, target, partials))

    def op_backward(saved: tuple[Tensor, ...], v_outputs: Gradients) -> Gradients:
        (image, target, partials), (v,) = saved, v_outputs
        assert v is not None
        if mean:
            scaled = Weights(0.0, weights.l1 / image.numel(), weights.similarity / image.numel())
            return backward(image, target, mask, scaled, partials, v.view(1)), None
        return backward(image, target, mask, weights, v * partials, v.new_ones(1)), None

    return differentiable(op, image, target.detach())[0]


def ssim_fwd(
    image: Tensor, target: Tensor, mask: Tensor | None, weights: Weights, with_partials: bool
) -> tuple[Tensor, Tensor]:
    """The weighted values [H, W, C] of the kernel, and the three partial derivatives of SSIM [3 or 0, H, W, C]."""
    values = torch.empty_like(image)
    partials = image.new_empty(3 if with_partials else 0, *image.shape)
    _launch(kernels.make_ssim_fwd(mask is not None), image, target, mask, *weights, values, partials)
    return values, partials


def ssim_bwd(
    image: Tensor, target: Tensor, mask: Tensor | None, weights: Weights, partials: Tensor, v_sum: Tensor
) -> Tensor:
    """The gradient of ``image`` [H, W, C], from that of the sum of all values [1]; ``base`` is not used."""
    v_image = torch.empty_like(image)
    _launch(kernels.make_ssim_bwd(mask is not None), image, target, mask, *weights[1:], partials, v_sum, v_image)
    return v_image


def _launch(kernel: Any, image: Tensor, target: Tensor, mask: Tensor | None, *arguments: Any) -> None:
    H, W, C = image.shape
    strip = kernels.SMALL_IMAGE_STRIP if is_small((W, H)) else kernels.STRIP
    mask_bytes = None if mask is None else mask.view(torch.uint8)
    threads = -(-H // strip) * W * C
    launch(kernel, threads, image, target, mask_bytes, strip, *arguments, block_dim=kernels.BLOCK_DIM, work=strip)


def _check_inputs(image: Tensor, target: Tensor, mask: Tensor | None, mean: bool) -> None:
    sizes: dict[str, int] = {}
    check_tensor("image", image, ("H", "W", "C"), sizes)
    check_tensor("target", target, ("H", "W", "C"), sizes)
    if mask is not None:
        check_tensor("mask", mask, ("H", "W"), sizes, (torch.bool,))
    check_same_device({"image": image, "target": target, "mask": mask})
    if mean and image.numel() == 0:
        raise ValueError(f"image must have pixels to compare, got shape {list(image.shape)}")
