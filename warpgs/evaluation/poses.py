"""Alignment of held-out cameras to a scene whose training poses were corrected (as in BARF, Lin et al. 2021)."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.data.capture import Frame
from warpgs.model.poses import PoseCorrections
from warpgs.model.splats import Splats
from warpgs.ops.adam import Adam
from warpgs.rendering import render
from warpgs.runs.trained import TrainedScene

ITERATIONS = 100
RATES = (3e-3, 3e-5)
"""Learning rate of Adam at the start and at the end [rad, and fractions of the unit]; exponential in between."""


Align = Callable[[Frame], Camera]
"""The camera of a frame, on the device of the scene."""


def alignment(scene: TrainedScene, unit: float) -> Align:
    """Aligns the cameras of frames if poses were corrected in training, else only moves them to the scene's device.

    Args:
        scene: The scene.
        unit: Length of a unit of translation: the extent of the capture [scene units].
    """

    def align(frame: Frame) -> Camera:
        camera = frame.camera.to(scene.device)
        if not scene.config.optim.poses:
            return camera
        truth = frame.image.to(scene.device).float() / 255.0
        region = None if frame.covisible is None else frame.covisible.to(scene.device)
        return aligned_camera(scene.splats(camera.time), camera, truth, unit, scene.config.antialias, region)

    return align


@torch.enable_grad()
def aligned_camera(
    splats: Splats,
    camera: Camera,
    truth: Float[Tensor, "H W 3"],
    unit: float,
    antialias: bool,
    region: Bool[Tensor, "H W"] | None = None,
) -> Camera:
    """The camera, moved by steps of Adam on the L1 distance between the rendered image and the ground truth.

    Corrections of training poses move and turn the scene as a whole, too, and a held-out camera cannot follow.

    Args:
        splats: The Gaussians at the camera's time.
        camera: On the device of the splats.
        truth: [H, W, 3] in [0, 1].
        unit: Length of a unit of translation [scene units].
        antialias: As in ``RenderSettings``.
        region: [H, W] the pixels that are compared; all if None.
    """
    poses = PoseCorrections(1, unit).to(camera.viewmat.device)
    index = torch.zeros(1, dtype=torch.int64, device=camera.viewmat.device)
    rate = torch.tensor(RATES[0], device=camera.viewmat.device)
    optimizer = Adam([{"params": list(poses.parameters()), "lr": rate}])
    settings = RenderSettings(antialias=antialias)
    for _ in range(ITERATIONS):
        image = render(splats, poses.moved(camera, index), settings=settings).joint.image
        optimizer.zero_grad()
        errors = (image - truth).abs()
        (errors if region is None else errors[region]).mean().backward()
        optimizer.step()
        rate *= (RATES[1] / RATES[0]) ** (1.0 / ITERATIONS)
    with torch.no_grad():
        return poses.moved(camera, index)
