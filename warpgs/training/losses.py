"""What a term of the training loss is, and the image losses of the paper (Eq. 9 and 12)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.config import LossConfig
from warpgs.initialization.alignment import DepthTrust
from warpgs.model.splats import Splats
from warpgs.ops.ssim import l1_and_ssim
from warpgs.rendering import Rendering
from warpgs.views.views import View

from .schedule import IterationPlan, Phase


class LossInputs(NamedTuple):
    """What a term of the loss is computed from.

    Attributes:
        config: Settings of the loss.
        view: The training view, with the ground truth.
        splats: The activated Gaussians at the view's time, static ones first; a few have an opacity of 0 with dropout.
        rendering: Joint, static and dynamic image; with depth where ``Phase.with_depth``.
        backgrounds: [3, 3] colours behind the joint, the static and the dynamic image.
        alignment: [2] scale and offset of the view's inverse depth; None unless ``Phase.with_depth``.
        depth_trust: How much the view's depth is trusted. None like ``alignment``.
        points: [3 K, 3] positions of ``sampled_points``, deformed [scene units]; None unless
            ``LossConfig.acceleration``, the deformation and dynamic Gaussians are in use.
        unit: Length that counts as 1 (``TrainConfig.length_unit``) [scene units].
    """

    config: LossConfig
    view: View
    splats: Splats
    rendering: Rendering
    backgrounds: Float[Tensor, "3 3"]
    alignment: Float[Tensor, "2"] | None
    depth_trust: DepthTrust | None
    points: Float[Tensor, "M 3"] | None = None
    unit: float = 1.0


class LossTerm(NamedTuple):
    """A term of the training loss.

    Attributes:
        compute: The term without its weight. It may branch on ``LossInputs.config`` and on nothing that changes during
            a run, and must not read values back from the device: on CUDA it is captured in a graph.
        is_active: Whether the term is computed in a phase.
        weight: The weight in an iteration; always 1 by default.
    """

    compute: Callable[[LossInputs], Float[Tensor, ""]]
    is_active: Callable[[Phase, LossConfig], bool]
    weight: Callable[[IterationPlan, LossConfig], float] = lambda plan, config: 1.0


def only_shown(rendering: Rendering, view: View, background: Float[Tensor, "3"]) -> Rendering:
    """The rendering with images that are right where the view shows nothing, so that nothing is learned there.

    Args:
        rendering: Of the view.
        view: The view, static where it shows nothing.
        background: [3] colour behind the dynamic image.
    """
    if view.shown is None:
        return rendering
    joint, static, dynamic = rendering[:3]
    return rendering._replace(
        joint=joint.only_where(view.shown, view.image),
        static=static and static.only_where(view.shown, view.image),
        dynamic=dynamic and dynamic.only_where(view.shown, background),
    )


def image_loss(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], ssim_weight: float) -> Float[Tensor, ""]:
    """L1 + λ (1 − SSIM) over all pixels."""
    if ssim_weight:
        return l1_and_ssim(image.contiguous(), truth, ssim_weight)
    return (image - truth).abs().mean()


def static_loss(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], static: Bool[Tensor, "H W"], ssim_weight: float
) -> Float[Tensor, ""]:
    """Paper Eq. 9: the static image against the ground truth, both masked by M, so that hidden parts stay free."""
    if ssim_weight:
        return l1_and_ssim(image.contiguous(), truth, ssim_weight, static)
    return ((image - truth) * static[..., None]).abs().mean()


def dynamic_loss(
    image: Float[Tensor, "H W 3"],
    truth: Float[Tensor, "H W 3"],
    static: Bool[Tensor, "H W"],
    ssim_weight: float,
    background: Float[Tensor, "3"],
    border: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, ""]:
    """Paper Eq. 12: the dynamic image, rendered over ``background``, against the ground truth masked by 1 − M.

    Only the ground truth is masked: where M = 1 the dynamic image has to show its background. In the ``border`` of the
    mask, which may be a few pixels off, the image is compared with itself: L1 is 0 there, and SSIM near it is closer
    to 1.
    """
    masked = torch.where(static[..., None], background, truth)
    if border is not None:
        masked = torch.where(border[..., None], image.detach(), masked)
    return image_loss(image, masked, ssim_weight)
