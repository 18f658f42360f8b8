"""The terms of the training loss (paper Eq. 9, 12, 14, 15).

To add one, write a ``LossTerm`` in a new file, add a line to ``TERMS`` and a test.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.ops.depth_error import depth_error
from warpgs.rendering import Layer

from . import losses
from .acceleration import acceleration
from .losses import LossInputs, LossTerm


def static(inputs: LossInputs) -> Float[Tensor, ""]:
    """The static image in the static region (Eq. 9)."""
    view, layer = inputs.view, inputs.rendering.static
    assert layer is not None
    return losses.static_loss(layer.image, view.image, view.static_mask, inputs.config.ssim) * view.mask_trust


def dynamic(inputs: LossInputs) -> Float[Tensor, ""]:
    """The dynamic image against the masked ground truth (Eq. 12), except along the borders of the mask."""
    view, layer = inputs.view, inputs.rendering.dynamic
    assert layer is not None
    images = (layer.image, view.image, view.static_mask)
    loss = losses.dynamic_loss(*images, inputs.config.ssim, inputs.backgrounds[2], view.mask_border)
    return loss * view.mask_trust


def joint(inputs: LossInputs) -> Float[Tensor, ""]:
    """The joint image against the whole ground truth."""
    return losses.image_loss(inputs.rendering.joint.image, inputs.view.image, inputs.config.ssim)


def squared(inputs: LossInputs) -> Float[Tensor, ""]:
    """The squared error of the joint image: what the PSNR measures."""
    return (inputs.rendering.joint.image - inputs.view.image).square().mean()


def _depth_error(
    inputs: LossInputs, layer: Layer | None, region: Bool[Tensor, "H W"], margin: Float[Tensor, ""]
) -> Float[Tensor, ""]:
    """The error of a layer's depth where its opacity exceeds a half, in a region of the mask, times the view's trust.

    In ``LossInputs.unit``. The rendered depth is divided by alpha: nearly empty pixels have gradients of 1 / alpha.
    """
    assert layer is not None
    assert layer.depth is not None
    assert inputs.alignment is not None
    assert inputs.depth_trust is not None
    error = depth_error(layer.depth, layer.alpha, inputs.view.inverse_depth, inputs.alignment, region, margin)
    return error * inputs.depth_trust.weight * inputs.view.mask_trust / inputs.unit


def depth(inputs: LossInputs) -> Float[Tensor, ""]:
    """The depth of the static image in the static region (Eq. 14)."""
    assert inputs.depth_trust is not None
    return _depth_error(inputs, inputs.rendering.static, inputs.view.static_mask, inputs.depth_trust.margin)


def depth_dynamic(inputs: LossInputs) -> Float[Tensor, ""]:
    """The depth of the dynamic image in the dynamic region; nothing else tells it, so every error counts."""
    assert inputs.depth_trust is not None
    no_margin = torch.zeros_like(inputs.depth_trust.margin)
    return _depth_error(inputs, inputs.rendering.dynamic, ~inputs.view.static_mask, no_margin)


TERMS: dict[str, LossTerm] = {
    "static": LossTerm(static, is_active=lambda phase, config: phase.with_branches),
    "dynamic": LossTerm(dynamic, is_active=lambda phase, config: phase.stage != "pretrain" and phase.with_branches),
    "joint": LossTerm(joint, is_active=lambda phase, config: phase.with_joint),
    "squared": LossTerm(
        squared,
        is_active=lambda phase, config: phase.with_joint and config.squared > 0,
        weight=lambda plan, config: config.squared,
    ),
    "acceleration": LossTerm(
        acceleration,
        is_active=lambda phase, config: phase.use_deformation and config.acceleration > 0,
        weight=lambda plan, config: config.acceleration,
    ),
    "depth": LossTerm(
        depth,
        is_active=lambda phase, config: phase.with_depth,
        weight=lambda plan, config: plan.depth_weight,
    ),
    "depth_dynamic": LossTerm(
        depth_dynamic,
        is_active=lambda phase, config: phase.with_depth and phase.stage != "pretrain" and config.depth_dynamic > 0,
        weight=lambda plan, config: config.depth_dynamic * plan.depth_weight,
    ),
}
"""Terms of the loss by name; gradients are accumulated in this order."""
