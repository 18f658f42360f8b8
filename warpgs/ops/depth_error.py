"""Mean error of depth against aligned monocular depth (kernels/depth_error.py)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import depth_error as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import LITTLE_WORK, Run, differentiable


def depth_error(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    inverse_depth: Float[Tensor, "H W"],
    alignment: Float[Tensor, "2"],
    region: Bool[Tensor, "H W"],
) -> Float[Tensor, ""]:
    """Mean over the image of |depth − target| [scene units], target = 1 / (scale · inverse_depth + offset); Eq. 14.

    Pixels that have nothing to compare count as zero. Differentiable in ``depth`` only.

    Args:
        depth: [H, W] of one branch, rendered, normalised by opacity.
        alpha: [H, W] opacity of what was drawn; pixels of at most a half are left out.
        inverse_depth: [H, W] monocular, NaN where unknown; there, and where the target is past 1000, pixels are left
            out.
        alignment: [2] scale and offset, on the device.
        region: [H, W] where to compare: M for the static branch.

    Raises:
        ValueError: On a wrong shape, dtype or device, or an image without pixels.
    """
    sizes: dict[str, int] = {}
    images = {"depth": depth, "alpha": alpha, "inverse_depth": inverse_depth}
    for name, value in images.items():
        check_tensor(name, value, ("H", "W"), sizes)
    check_tensor("alignment", alignment, (2,), sizes)
    check_tensor("region", region, ("H", "W"), sizes, (torch.bool,))
    check_same_device({**images, "alignment": alignment, "region": region})
    if depth.numel() == 0:
        raise ValueError(f"depth must have pixels to compare, got shape {list(depth.shape)}")

    def op(run: Run, depth: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        inputs = (depth.view(-1), *(t.view(-1) for t in others), region.view(torch.uint8).view(-1))
        errors = run.empty(depth.numel())
        run.launch(kernels.depth_error_fwd, depth.numel(), *inputs, errors, work=LITTLE_WORK)
        result = errors.mean()

        def backward(run: Run) -> None:
            v = run.adjoint(result)
            if v is not None:
                v_depth = run.empty(*depth.shape)
                cotangents = (1.0 / depth.numel(), v.view(1), v_depth.view(-1))
                run.launch(kernels.depth_error_bwd, depth.numel(), *inputs, *cotangents, work=LITTLE_WORK)
                run.add_adjoint(depth, v_depth)

        run.on_backward(backward)
        return (result,)

    return differentiable(op, depth, alpha.detach(), inverse_depth.detach(), alignment.detach())[0]
