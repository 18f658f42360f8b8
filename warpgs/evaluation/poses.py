"""Alignment of held-out cameras to a scene whose training poses were corrected (as in BARF, Lin et al. 2021)."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.poses import PoseCorrections
from warpgs.model.splats import Splats
from warpgs.rendering import render

ITERATIONS = 100
RATES = (3e-3, 3e-5)
"""Learning rate of Adam at the start and at the end [rad, and fractions of the unit]; exponential in between."""


@torch.enable_grad()
def aligned_camera(
    splats: Splats, camera: Camera, truth: Float[Tensor, "H W 3"], unit: float, antialias: bool
) -> Camera:
    """The camera, moved to where the rendered image has the smallest L1 distance from the ground truth.

    Corrections of training poses move and turn the scene as a whole, too, and a held-out camera cannot follow.

    Args:
        splats: The Gaussians at the camera's time.
        camera: On the device of the splats.
        truth: [H, W, 3] in [0, 1].
        unit: Length of a unit of translation [scene units].
        antialias: As in ``RenderSettings``.
    """
    poses = PoseCorrections(1, unit).to(camera.viewmat.device)
    index = torch.zeros(1, dtype=torch.int64, device=camera.viewmat.device)
    optimizer = torch.optim.Adam(poses.parameters(), lr=RATES[0])
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, (RATES[1] / RATES[0]) ** (1.0 / ITERATIONS))
    settings = RenderSettings(antialias=antialias)
    for _ in range(ITERATIONS):
        moved = dataclasses.replace(camera, viewmat=poses(camera.viewmat, index))
        image = render(splats, moved, settings=settings).joint.image
        optimizer.zero_grad()
        (image - truth).abs().mean().backward()
        optimizer.step()
        schedule.step()
    return dataclasses.replace(camera, viewmat=poses(camera.viewmat, index).detach())
