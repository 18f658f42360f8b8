"""Mean error of depth against aligned monocular depth (kernels/depth_error.py)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels import depth_error as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import LITTLE_WORK, launch
from warpgs.runtime.tape import Gradients, Recorded, differentiable


def depth_error(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    inverse_depth: Float[Tensor, "H W"],
    alignment: Float[Tensor, "2"],
    region: Bool[Tensor, "H W"],
    margin: Float[Tensor, ""],
) -> Float[Tensor, ""]:
    """Mean over the image of max(|depth − target| − margin · target, 0) [scene units]; Eq. 14 with a margin of 0.

    target = 1 / (scale · inverse_depth + offset); 0 where not compared. Differentiable in ``depth`` only.

    Args:
        depth: [H, W] rendered depth of one branch, normalised by opacity [scene units].
        alpha: [H, W] rendered opacity; pixels with at most 0.5 are not compared.
        inverse_depth: [H, W] monocular inverse depth; pixels with NaN or a target above 1000 are not compared.
        alignment: [2] scale and offset, on the device.
        region: [H, W] the pixels to compare: M for the static branch.
        margin: Relative error of the target that is not penalized, on the device; 0 penalizes every error.

    Raises:
        ValueError: On a wrong shape, dtype or device, or an image without pixels.
    """
    _check_inputs({"depth": depth, "alpha": alpha, "inverse_depth": inverse_depth}, alignment, region, margin)
    num_pixels, mask = depth.numel(), region.view(torch.uint8).view(-1)

    def op(*tensors: Tensor) -> Recorded:
        errors = tensors[0].new_empty(num_pixels)
        launch(kernels.depth_error_fwd, num_pixels, *(t.view(-1) for t in tensors), mask, errors, work=LITTLE_WORK)
        return Recorded((errors.mean(),), backward, tensors)

    def backward(saved: tuple[Tensor, ...], v_outputs: Gradients) -> Gradients:
        (v_mean,) = v_outputs
        assert v_mean is not None
        v_depth = torch.empty_like(saved[0])
        outputs = (1.0 / num_pixels, v_mean.view(1), v_depth.view(-1))
        launch(kernels.depth_error_bwd, num_pixels, *(t.view(-1) for t in saved), mask, *outputs, work=LITTLE_WORK)
        return v_depth, None, None, None, None

    return differentiable(op, depth, *(t.detach() for t in (alpha, inverse_depth, alignment, margin)))[0]


def _check_inputs(images: dict[str, Tensor], alignment: Tensor, region: Tensor, margin: Tensor) -> None:
    sizes: dict[str, int] = {}
    for name, value in images.items():
        check_tensor(name, value, ("H", "W"), sizes)
    check_tensor("alignment", alignment, (2,), sizes)
    check_tensor("margin", margin, (), sizes)
    check_tensor("region", region, ("H", "W"), sizes, (torch.bool,))
    check_same_device({**images, "alignment": alignment, "region": region, "margin": margin})
    if region.numel() == 0:
        raise ValueError(f"depth must have pixels to compare, got shape {list(region.shape)}")
