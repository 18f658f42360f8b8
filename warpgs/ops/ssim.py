"""Fused structural similarity (SSIM), alone or together with the L1 loss (kernels/ssim.py)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import ssim as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import launch
from warpgs.runtime.tape import Gradients, Recorded, differentiable

from .compositing import is_small

SIMILARITY = (0.0, 0.0, 1.0)
"""The weights base, l1 and similarity of the kernels (kernels/ssim.py) for SSIM alone."""


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
    return _compare(image, target, mask, (ssim_weight, 1.0, -ssim_weight), mean=True)


def _compare(
    image: Tensor, target: Tensor, mask: Tensor | None, weights: tuple[float, float, float], mean: bool
) -> Tensor:
    """base + l1 |image − target| + similarity SSIM: the mean, or without L1 the [H, W, C] values."""
    assert mean or weights == SIMILARITY
    _check_inputs(image, target, mask, mean)
    mask_bytes = None if mask is None else mask.view(torch.uint8)
    H, W, C = image.shape
    strip = kernels.CPU_STRIP
    if image.is_cuda:
        strip = kernels.SMALL_IMAGE_STRIP if is_small((W, H)) else kernels.STRIP
    threads = -(-H // strip) * W * C
    _, l1, similarity = weights
    with_mask = mask is not None

    def op(image: Tensor, target: Tensor) -> Recorded:
        values = image.new_empty(H, W, C)
        partials = image.new_empty(3 if image.requires_grad else 0, H, W, C)
        outputs = (*weights, values, partials)
        launch(kernels.make_ssim_fwd(with_mask), threads, image, target, mask_bytes, strip, *outputs, work=strip)
        return Recorded((values.mean() if mean else values,), backward, (image, target, partials))

    def backward(saved: tuple[Tensor, ...], v_outputs: Gradients) -> Gradients:
        (image, target, partials), (v,) = saved, v_outputs
        assert v is not None
        v_image = torch.empty_like(image)
        scale, scaled_partials = (1.0 / image.numel(), partials) if mean else (1.0, v * partials)
        v_sum = v.view(1) if mean else v.new_ones(1)
        arguments = (scale * l1, scale * similarity, scaled_partials, v_sum, v_image)
        launch(kernels.make_ssim_bwd(with_mask), threads, image, target, mask_bytes, strip, *arguments, work=strip)
        return v_image, None

    return differentiable(op, image, target.detach())[0]


def _check_inputs(image: Tensor, target: Tensor, mask: Tensor | None, mean: bool) -> None:
    sizes: dict[str, int] = {}
    check_tensor("image", image, ("H", "W", "C"), sizes)
    check_tensor("target", target, ("H", "W", "C"), sizes)
    if mask is not None:
        check_tensor("mask", mask, ("H", "W"), sizes, (torch.bool,))
    check_same_device({"image": image, "target": target, "mask": mask})
    if mean and image.numel() == 0:
        raise ValueError(f"image must have pixels to compare, got shape {list(image.shape)}")
