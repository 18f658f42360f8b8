"""Alignment of held-out cameras to a scene whose training poses were corrected (direct image alignment)."""

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import huber_loss

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.data.capture import Frame
from warpgs.data.responses import Response
from warpgs.least_squares import Problem, minimize
from warpgs.model.poses import PoseCorrections
from warpgs.model.splats import Splats
from warpgs.rendering import render
from warpgs.runs.trained import TrainedScene

MAX_TRIALS, MIN_GAIN = 16, 1e-3
"""Maximum number of steps that are tried, and the minimum relative gain of the loss for which another one is."""

MAX_CORRECTION = 0.05
"""Maximum of each component of a correction [rad, and fractions of the unit]: a poor scene must not lead far away."""

DIFFERENCE = 0.15
"""Step of the derivatives of an image by the pose [px at the image's centre, for translations at the median depth]."""

ROBUST_ERROR = 0.03
"""Error of a channel, in [0, 1], beyond which the loss grows linearly: what moves may be at another place."""

Align = Callable[[Frame], Camera]
"""The camera of a frame, on the device of the scene."""

Errors = Callable[[Float[Tensor, "6"]], Float[Tensor, " M"]]
"""Errors of an image from a pose: its rotation and translation."""


def alignment(scene: TrainedScene, unit: float, responses: Mapping[int, Response] = MappingProxyType({})) -> Align:
    """Aligns the cameras of frames if poses were corrected in training, else only moves them to the scene's device.

    Args:
        scene: The scene.
        unit: Length of a unit of translation: the median depth of the capture [scene units].
        responses: As of ``camera_responses``: frames are divided by that of their camera.
    """

    def align(frame: Frame) -> Camera:
        camera = frame.camera.to(scene.device)
        if not scene.config.optim.poses:
            return camera
        truth = frame.image.to(scene.device).float() / 255.0
        if (response := responses.get(camera.id)) is not None:
            truth = truth / response.at(camera.time).to(scene.device)
        region = camera.shown if frame.covisible is None else frame.covisible.to(scene.device)
        splats = scene.splats(camera.time, camera=camera)
        return aligned_camera(splats, camera, truth, unit, scene.config.render_settings, region)

    return align


@torch.no_grad()
def aligned_camera(
    splats: Splats,
    camera: Camera,
    truth: Float[Tensor, "H W 3"],
    unit: float,
    settings: RenderSettings,
    region: Bool[Tensor, "H W"] | None = None,
) -> Camera:
    """The camera, moved to where the rendered image is nearest to the ground truth, by the Huber loss.

    Corrections of training poses move and turn the scene as a whole, too, and a held-out camera cannot follow.

    Args:
        splats: The Gaussians at the camera's time.
        camera: On the device of the splats.
        truth: [H, W, 3] in [0, 1].
        unit: Length of a unit of translation [scene units].
        settings: How images are rendered.
        region: [H, W] the pixels that are compared; all if None.
    """
    device = camera.viewmat.device
    index = torch.zeros(1, dtype=torch.int64, device=device)
    poses = PoseCorrections(index, unit).to(device)

    def moved(pose: Float[Tensor, "6"]) -> Camera:
        poses.rotations.copy_(pose[None, :3])
        poses.translations.copy_(pose[None, 3:])
        return poses.moved(camera, index)

    def errors(pose: Float[Tensor, "6"]) -> Float[Tensor, " M"]:
        difference = render(splats, moved(pose), settings=settings).joint.image - truth
        return (difference if region is None else difference[region]).flatten()

    problem = Problem(errors, _loss, partial(_normal_equations, errors, DIFFERENCE / float(camera.K[0, 0])))
    start = torch.zeros(6, dtype=torch.float32, device=device)
    return moved(minimize(problem, start, MAX_TRIALS, MIN_GAIN, MAX_CORRECTION))


def _normal_equations(
    errors: Errors, width: float, pose: Float[Tensor, "6"], error: Float[Tensor, " M"]
) -> tuple[Float[Tensor, "6 6"], Float[Tensor, "6"]]:
    """Those of ``Problem``, with differences over a width as derivatives."""
    axes = torch.eye(len(pose), dtype=torch.float32, device=pose.device)
    roots = error.abs().clamp_min(ROBUST_ERROR).rsqrt()  # of the weights
    derivatives = torch.stack([(errors(pose + width * axis) - error) * (roots / width) for axis in axes])
    return derivatives @ derivatives.T, derivatives @ (roots * error)


def _loss(error: Float[Tensor, " M"]) -> float:
    return float(huber_loss(error, torch.zeros_like(error), delta=ROBUST_ERROR))
