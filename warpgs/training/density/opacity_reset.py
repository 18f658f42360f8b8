"""Resets of opacities, after which Gaussians that are not needed become removable (3DGS, section 5.2)."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam
from warpgs.rendering import opacities_on_screen
from warpgs.training.schedule import Phase

from .adaptation import Adaptation
from .operations import reset_moments

RESET_OPACITY = 0.01
"""Maximum opacity on screen after a reset (3DGS)."""


@torch.no_grad()
def reset_opacities(
    scene: SplitScene, optimizer: Adam, cameras: Iterable[Camera], phase: Phase, settings: RenderSettings
) -> None:
    """Lowers all opacities, so that each Gaussian shows at most 0.01 in the view that shows it faintest.

    Without ``antialias`` that is an opacity of 0.01, as in 3DGS. With it, a splat of that opacity and a standard
    deviation below 0.7 pixels may be fainter than 1/255 in every pixel: it would get no gradient and never come back.

    Args:
        scene: Changed in place, together with the optimizer's moments.
        optimizer: From ``optimizer.make_optimizer``.
        cameras: Of the training views, on the scene's device.
        phase: Says whether the deformation is in use.
        settings: How images are rendered.
    """
    compensations = _compensations(scene, cameras if settings.antialias else (), phase, settings)
    highest = torch.logit((RESET_OPACITY / compensations).clamp(max=1.0))
    branches = (scene.static, scene.dynamic)
    for gaussians, limits in zip(branches, highest.split([len(gaussians) for gaussians in branches]), strict=True):
        gaussians.logit_opacities.clamp_(max=limits)
        reset_moments(optimizer, gaussians.logit_opacities)


def reset(at: Adaptation) -> None:
    """Resets the opacities of both branches."""
    reset_opacities(at.scene, at.optimizer, at.views.cameras(), at.plan.phase, at.config.render_settings)


def _compensations(
    scene: SplitScene, cameras: Iterable[Camera], phase: Phase, settings: RenderSettings
) -> Float[Tensor, " N"]:
    """The smallest factor by which a view that shows a Gaussian lowers its opacity; 1 for those that none shows.

    The opacity is that of w⁰, without residuals of the appearance network.
    """
    found = torch.ones(len(scene.static) + len(scene.dynamic), dtype=torch.float32, device=scene.static.means.device)
    for camera in cameras:
        time = found.new_full((1,), camera.time)
        delays = scene.with_delays(camera, time)
        splats = scene.splats(time, phase.use_deformation, use_appearance=False, time_noise=delays)
        on_screen = opacities_on_screen(splats, camera, settings)
        found = torch.where(on_screen > 0.0, torch.minimum(found, on_screen / splats.opacities), found)
    return found
