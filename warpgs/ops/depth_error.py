"""Mean error of depth against aligned monocular depth (kernels/depth_error.py)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import depth_error as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import LITTLE_WORK, OpContext, differentiable


def depth_error(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    inverse_depth: Float[Tensor, "H W"],
    alignment: Float[Tensor, "2"],
    region: Bool[Tensor, "H W"],
) -> Float[Tensor, ""]:
    """Mean over the image of |depth − target| [scene units], target = 1 / (scale · inverse_depth + offset); Eq. 14.

    Pixels that are not compared count as zero. Differentiable in ``depth`` only.

    Args:
        depth: [H, W] rendered depth of one branch, normalised by opacity [scene units].
        alpha: [H, W] rendered opacity; pixels with at most 0.5 are not compared.
        inverse_depth: [H, W] monocular inverse depth; pixels with NaN or a target above 1000 are not compared.
        alignment: [2] scale and offset, on the device.
        region: [H, W] the pixels to compare: M for the static branch.

    Raises:
        ValueError: On a wrong shape, dtype or device, or an image without pixels.
    """
    _check_inputs({"depth": depth, "alpha": alpha, "inverse_depth": inverse_depth}, alignment, region)

    def op(ctx: OpContext, depth: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        inputs = (depth.view(-1), *(t.view(-1) for t in others), region.view(torch.uint8).view(-1))
        errors = ctx.empty(depth.numel())
        ctx.launch(kernels.depth_error_fwd, depth.numel(), *inputs, errors, work=LITTLE_WORK)
        result = errors.mean()

        def backward(ctx: OpContext) -> None:
            if (v := ctx.gradient(result)) is not None:
                v_depth = ctx.empty(*depth.shape)
                gradients = (1.0 / depth.numel(), v.view(1), v_depth.view(-1))
                ctx.launch(kernels.depth_error_bwd, depth.numel(), *inputs, *gradients, work=LITTLE_WORK)
                ctx.add_gradient(depth, v_depth)

        ctx.on_backward(backward)
        return (result,)

    return differentiable(op, depth, alpha.detach(), inverse_depth.detach(), alignment.detach())[0]


def _check_inputs(images: dict[str, Tensor], alignment: Tensor, region: Tensor) -> None:
    sizes: dict[str, int] = {}
    for name, value in images.items():
        check_tensor(name, value, ("H", "W"), sizes)
    check_tensor("alignment", alignment, (2,), sizes)
    check_tensor("region", region, ("H", "W"), sizes, (torch.bool,))
    check_same_device({**images, "alignment": alignment, "region": region})
    if region.numel() == 0:
        raise ValueError(f"depth must have pixels to compare, got shape {list(region.shape)}")
