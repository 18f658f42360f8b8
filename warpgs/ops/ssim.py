"""Fused structural similarity, alone or with the absolute difference beside it (kernels/ssim.py)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import ssim as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import Run, differentiable

from .compositing import is_small

SIMILARITY = (0.0, 0.0, 1.0)
"""Weights of the kernels, base, L1 and similarity, for similarity alone."""


def ssim_map(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W C"]:
    """Structural similarity around each pixel and channel; see ``ssim``."""
    return _compare(image, target, mask, SIMILARITY, mean=False)


def ssim(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Mean structural similarity over pixels and channels; differentiable in ``image`` only.

    11×11 Gaussian window of σ = 1.5 and zero padding, as in 3DGS, for values in [0, 1].

    Args:
        image: [H, W, C] rendered image.
        target: [H, W, C] what it should be; gets no gradient.
        mask: [H, W] where true, both images count; elsewhere both are taken as zero (paper Eq. 9). The mean still runs
            over the whole image.

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
    """Mean of |image − target| + λ (1 − SSIM) over pixels and channels, in one pass; otherwise as ``ssim``.

    Args:
        ssim_weight: λ.
    """
    return _compare(image, target, mask, (ssim_weight, 1.0, -ssim_weight), mean=True)


def _compare(
    image: Tensor, target: Tensor, mask: Tensor | None, weights: tuple[float, float, float], mean: bool
) -> Tensor:
    """base + l1 |image − target| + similarity SSIM: the mean, or [H, W, C] of each pixel and channel, without L1."""
    assert mean or weights == SIMILARITY
    sizes: dict[str, int] = {}
    check_tensor("image", image, ("H", "W", "C"), sizes)
    check_tensor("target", target, ("H", "W", "C"), sizes)
    if mask is not None:
        check_tensor("mask", mask, ("H", "W"), sizes, (torch.bool,))
    check_same_device({"image": image, "target": target, "mask": mask})
    if mean and image.numel() == 0:
        raise ValueError(f"image must have pixels to compare, got shape {list(image.shape)}")
    kept = None if mask is None else mask.view(torch.uint8)
    H, W, C = image.shape
    strip = kernels.STRIP_OF_SMALL if image.is_cuda and is_small((W, H)) else kernels.STRIP
    threads = -(-H // strip) * W * C
    _, l1, similarity = weights

    def op(run: Run, image: Tensor, target: Tensor) -> tuple[Tensor, ...]:
        values = run.empty(H, W, C)
        partials = run.empty(3 if run.needs_grad else 0, H, W, C)
        images = (image, target, kept, strip)
        kernel = kernels.make_ssim_fwd(kept is not None)
        run.launch(kernel, threads, *images, *weights, values, partials, work=strip)
        result = values.mean() if mean else values

        def backward(run: Run) -> None:
            v = run.adjoint(result)
            if v is None:
                return
            v_image = run.empty(H, W, C)
            scale, slopes = (1.0 / image.numel(), partials) if mean else (1.0, v * partials)
            v_sum = v.view(1) if mean else v.new_ones(1)
            kernel = kernels.make_ssim_bwd(kept is not None)
            arguments = (scale * l1, scale * similarity, slopes, v_sum, v_image)
            run.launch(kernel, threads, *images, *arguments, work=strip)
            run.add_adjoint(image, v_image)

        run.on_backward(backward)
        return (result,)

    return differentiable(op, image, target.detach())[0]
