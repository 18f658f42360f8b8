"""Fused structural similarity (kernels/ssim.py)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import ssim as kernels

from .contracts import check_same_device, check_tensor
from .tape import Run, differentiable


def ssim_map(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W C"]:
    """Structural similarity around each pixel and channel; see ``ssim``."""
    sizes: dict[str, int] = {}
    check_tensor("image", image, ("H", "W", "C"), sizes)
    check_tensor("target", target, ("H", "W", "C"), sizes)
    if mask is not None:
        check_tensor("mask", mask, ("H", "W"), sizes, (torch.bool,))
    check_same_device({"image": image, "target": target, "mask": mask})
    kept = None if mask is None else mask.view(torch.uint8)
    H, W, C = image.shape
    strips = -(-H // kernels.STRIP)

    def op(run: Run, image: Tensor, target: Tensor) -> tuple[Tensor, ...]:
        similarity = run.empty(H, W, C)
        partials = run.empty(3, H, W, C) if run.needs_grad else None
        run.launch(
            kernels.make_ssim_fwd(kept is not None),
            strips * W * C,
            image,
            target,
            kept,
            similarity,
            partials,
            work=kernels.STRIP,
        )

        def backward(run: Run) -> None:
            v_similarity = run.adjoint(similarity)
            if v_similarity is not None:
                v_image = run.empty(H, W, C)
                run.launch(
                    kernels.make_ssim_bwd(kept is not None),
                    strips * W * C,
                    image,
                    target,
                    kept,
                    partials,
                    v_similarity,
                    v_image,
                    work=kernels.STRIP,
                )
                run.add_adjoint(image, v_image)

        run.on_backward(backward)
        return (similarity,)

    return differentiable(op, image, target.detach())[0]


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
    if isinstance(image, Tensor) and image.numel() == 0:
        raise ValueError(f"image must have pixels to compare, got shape {list(image.shape)}")
    return ssim_map(image, target, mask).mean()
