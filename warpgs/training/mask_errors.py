"""Completes masks that miss what moves: blocks of pixels that the static image does not show become dynamic.

Static Gaussians would explain them by an appearance that changes with time, and what moves stays in the static image.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import RenderSettings, TrainConfig
from warpgs.model.scene import SplitScene
from warpgs.rendering import render

from . import ranks
from .blocks import block_means
from .schedule import Phase
from .views import View, Views

MIN_STATIC = 0.25
"""Blocks of which the mask calls less than this fraction static are left as they are."""

MAX_ADDED = 0.25
"""A view of whose static blocks more than this fraction would be added in all is not learned well enough yet."""


def complete_masks(scene: SplitScene, views: Views, phase: Phase, config: TrainConfig) -> str:
    """Adds to ``views.moving_blocks`` what the static image does not show; says what, or nothing.

    Colours are compared after the mean over a block, so that details that are not learned yet do not count. Blocks stay
    dynamic once they are.

    Args:
        scene: The scene.
        views: Training views, on the scene's device.
        phase: Says which networks and which degree of spherical harmonics are in use.
        config: Has the tolerance.
    """
    blocks, added, changed = views.moving_blocks(), 0, 0
    settings = RenderSettings(branches=True, antialias=config.antialias)
    background = torch.full((3,), float(views.background == "white"), device=views.device)
    for index in range(len(views)):
        view = views[index]
        errors = _errors(scene, view, phase, background, settings).cpu()
        rows, columns = errors.shape
        found, before = errors > config.loss.mask_tolerance, blocks[index, :rows, :columns]
        num, earlier = int(found.sum()), int(before.sum())
        if 0 < num <= MAX_ADDED * (int(errors.isfinite().sum()) + earlier) - earlier:
            before += found
            added, changed = added + num, changed + 1
    if not added:
        return ""
    views.set_moving_blocks(blocks)
    return f"masks miss what moves in {changed} of {len(views)} views: {added:,} blocks of pixels are dynamic now, too"


@torch.no_grad()
def _errors(
    scene: SplitScene, view: View, phase: Phase, background: Float[Tensor, "3"], settings: RenderSettings
) -> Float[Tensor, "h w"]:
    """Colour error of the static image in each block, over its static pixels; NaN where there are too few."""
    splats = scene.splats(view.time, phase.use_deformation, phase.use_appearance, phase.sh_degree)
    layer = render(splats, view.camera, background, settings).static
    assert layer is not None
    static = view.static_mask[..., None].float()
    fraction = block_means(static)[..., 0]
    error = block_means((layer.image - view.image) * static).abs().mean(-1) / fraction.clamp(min=MIN_STATIC)
    return torch.where(fraction >= MIN_STATIC, error, torch.nan)


def send_from_first(views: Views) -> None:
    """Gives all ranks the blocks of rank 0."""
    if ranks.num_ranks() > 1:
        blocks = views.moving_blocks()
        ranks.copy_first_(blocks)
        views.set_moving_blocks(blocks)
