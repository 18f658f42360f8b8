"""Acceleration of dynamic Gaussians, which tells how they move between frames.

Images say where things are in training frames, and nothing about the times between them: a network that fits every
frame may lead an object astray in between, as a polynomial of high degree does. So the second differences of its
positions over three frames should be small. They are measured in pixels, and thus mean the same in all captures.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.model.scene import PointsInTime, SplitScene
from warpgs.ops.dropout import MAX_SEED

from .losses import LossInputs

MAX_SAMPLES = 1_024
"""Maximum number of Gaussians whose paths an iteration looks at."""

MIN_DEPTH = 1e-3
"""Minimum depth of a Gaussian in front of the camera, relative to the farthest, so that its pixels have some size."""


def sampled_points(
    scene: SplitScene, time: Float[Tensor, "1"], interval: float, seed: Float[Tensor, "1"]
) -> PointsInTime:
    """A sample of the dynamic Gaussians one frame before a moment, then, and one frame after.

    The moment is random, up to half a frame from ``time``.

    Args:
        scene: The scene.
        time: Time of a view in [0, 1].
        interval: Time between frames.
        seed: An integer below ``MAX_SEED``, which chooses the moment and the sample.

    Returns:
        K canonical positions, at most ``MAX_SAMPLES``, at each of the three times; none without dynamic Gaussians.
    """
    means, _ = scene.around(time)
    # Consecutive Gaussians, so that nothing is sorted or drawn: each belongs to as many samples as any other.
    count = min(len(means), MAX_SAMPLES)
    first = torch.arange(count, device=means.device)
    means = means[(first + seed.long()) % max(len(means), 1)]
    moment = time + (seed / MAX_SEED - 0.5) * interval
    shifts = (moment - interval, moment, moment + interval)
    return PointsInTime(means.repeat(3, 1), torch.cat([shift.expand(count) for shift in shifts]))


def acceleration(inputs: LossInputs) -> Float[Tensor, ""]:
    """Acceleration of ``sampled_points``, deformed, as the camera sees it [pixels per frame²].

    Accelerations a well below one pixel count as a², larger ones as a: a² / √(a² + 1). Those behind the camera, where a
    pixel has no size, count as 0. The mean is multiplied by the fraction of the pixels that are dynamic, because the
    image terms pull at small objects as much less. Neither depth nor camera gets a gradient for making pixels larger.
    """
    if inputs.points is None:
        return inputs.view.image.new_zeros(())
    (before, now, after), camera = inputs.points.view(3, -1, 3), inputs.view.camera
    with torch.no_grad():
        depth = camera.depths(now)
        pixels = torch.where(depth > 0.0, camera.focal / depth.clamp_min(MIN_DEPTH * depth.abs().max()), 0.0)
    squared = ((before - 2.0 * now + after) * pixels[:, None]).square().sum(1)
    dynamic_fraction = (~inputs.view.static_mask).float().mean()
    return (squared / (squared + 1.0).sqrt()).mean() * dynamic_fraction
