"""Alignment of held-out cameras to a scene whose training poses were corrected (direct image alignment)."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import huber_loss

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.data.capture import Frame
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

DAMPING, DAMPING_FACTOR = 1e-3, 10.0
"""Initial damping of Levenberg and Marquardt, and the factor by which failures raise it and successes lower it."""


Align = Callable[[Frame], Camera]
"""The camera of a frame, on the device of the scene."""

Errors = Callable[[Float[Tensor, "6"]], Float[Tensor, " M"]]
"""Errors of an image from a pose: its rotation and translation."""


def alignment(scene: TrainedScene, unit: float) -> Align:
    """Aligns the cameras of frames if poses were corrected in training, else only moves them to the scene's device.

    Args:
        scene: The scene.
        unit: Length of a unit of translation: the median depth of the capture [scene units].
    """

    def align(frame: Frame) -> Camera:
        camera = frame.camera.to(scene.device)
        if not scene.config.optim.poses:
            return camera
        truth = frame.image.to(scene.device).float() / 255.0
        region = None if frame.covisible is None else frame.covisible.to(scene.device)
        return aligned_camera(scene.splats(camera.time), camera, truth, unit, scene.config.render_settings, region)

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
    poses, index = PoseCorrections(1, unit).to(device), torch.zeros(1, dtype=torch.int64, device=device)

    def moved(pose: Float[Tensor, "6"]) -> Camera:
        poses.rotations.copy_(pose[None, :3])
        poses.translations.copy_(pose[None, 3:])
        return poses.moved(camera, index)

    def errors(pose: Float[Tensor, "6"]) -> Float[Tensor, " M"]:
        difference = render(splats, moved(pose), settings=settings).joint.image - truth
        return (difference if region is None else difference[region]).flatten()

    return moved(
        _minimize(errors, torch.zeros(6, dtype=torch.float32, device=device), DIFFERENCE / float(camera.K[0, 0]))
    )


def _minimize(errors: Errors, pose: Float[Tensor, "6"], width: float) -> Float[Tensor, "6"]:
    """The pose with the smallest Huber loss of the errors, from a pose on, by the method of Levenberg and Marquardt.

    Derivatives of the errors by the pose, of which there are six, are differences over a width.
    """
    error, damping = errors(pose), DAMPING
    loss = _loss(error)
    normal, gradient = _normal_equations(errors, pose, error, width)
    for _ in range(MAX_TRIALS):
        # The small number keeps the matrix regular where no pixel depends on the pose.
        damped = normal + (damping * normal.diagonal() + 1e-9).diag()
        trial = (pose - torch.linalg.solve(damped, gradient)).clamp(-MAX_CORRECTION, MAX_CORRECTION)
        trial_error = errors(trial)
        trial_loss = _loss(trial_error)
        if not trial_loss < loss:
            damping *= DAMPING_FACTOR
            continue
        gain, damping = 1.0 - trial_loss / loss, damping / DAMPING_FACTOR
        pose, error, loss = trial, trial_error, trial_loss
        if gain < MIN_GAIN:
            break
        normal, gradient = _normal_equations(errors, pose, error, width)
    return pose


def _normal_equations(
    errors: Errors, pose: Float[Tensor, "6"], error: Float[Tensor, " M"], width: float
) -> tuple[Float[Tensor, "6 6"], Float[Tensor, "6"]]:
    """JᵀWJ and JᵀWe, of the errors e with derivatives J and the weights W that make their squares the Huber loss."""
    axes = torch.eye(len(pose), dtype=torch.float32, device=pose.device)
    roots = error.abs().clamp_min(ROBUST_ERROR).rsqrt()  # of the weights
    derivatives = torch.stack([(errors(pose + width * axis) - error) * (roots / width) for axis in axes])
    return derivatives @ derivatives.T, derivatives @ (roots * error)


def _loss(error: Float[Tensor, " M"]) -> float:
    return float(huber_loss(error, torch.zeros_like(error), delta=ROBUST_ERROR))
