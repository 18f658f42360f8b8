"""Acceleration of dynamic Gaussians, which tells how they move between frames.

Images say where things are in training frames, and nothing about the times between them: a network that fits every
frame may lead an object astray in between, as a polynomial of high degree does. So the second differences of its
positions over three frames should be small. They are measured in pixels, and thus mean the same in all captures.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.model.scene import SplitScene
from warpgs.ops.dropout import MAX_SEED

from .losses import LossInputs

MAX_SAMPLES = 1_024
"""Maximum number of Gaussians whose paths an iteration looks at."""

MIN_DEPTH = 1e-3
"""Minimum depth of a Gaussian in front of the camera, relative to the farthest, so that its pixels have some size."""


def sample_paths(
    scene: SplitScene, time: Float[Tensor, "1"], interval: float, seed: Float[Tensor, "1"]
) -> Float[Tensor, "3 K 3"]:
    """Positions of a sample of the dynamic Gaussians, one frame before a moment, then, and one frame after.

    The moment is random, up to half a frame from ``time``. Only the deformation gets gradients.

    Args:
        scene: The scene.
        time: Time of a view in [0, 1].
        interval: Time between frames.
        seed: An integer below ``MAX_SEED``, which chooses the moment and the sample.

    Returns:
        [3, K, 3] positions [scene units]; K is at most ``MAX_SAMPLES``, 0 without dynamic Gaussians.
    """
    means = scene.dynamic.means.detach()
    if not len(means):
        return means.new_zeros(3, 0, 3)
    # Consecutive Gaussians, so that nothing is sorted or drawn: each belongs to as many samples as any other.
    count = min(len(means), MAX_SAMPLES)
    first = torch.arange(count, device=means.device)
    means = means[(first + seed.long()) % len(means)]
    moment = time + (seed / MAX_SEED - 0.5) * interval
    # In one evaluation: the kernels of three small ones take longer.
    shifts = (moment - interval, moment, moment + interval)
    times = torch.cat([shift.expand(count) for shift in shifts])
    return means + scene.deformation(means.repeat(3, 1), times)[:, :3].view(3, count, 3)


def acceleration(inputs: LossInputs) -> Float[Tensor, ""]:
    """Acceleration of the sampled dynamic Gaussians as the view's camera sees it [pixels per frame²].

    Accelerations a well below one pixel count as a², larger ones as a: a² / √(a² + 1). Those behind the camera, where a
    pixel has no size, count as 0. The mean is multiplied by the fraction of the pixels that are dynamic, because the
    image terms pull at small objects as much less. Neither depth nor camera gets a gradient for making pixels larger.
    """
    paths, camera = inputs.paths, inputs.view.camera
    assert paths is not None
    before, now, after = paths
    if not len(now):
        return paths.sum()
    with torch.no_grad():
        depth = camera.depths(now)
        pixels = torch.where(depth > 0.0, camera.focal / depth.clamp_min(MIN_DEPTH * depth.abs().max()), 0.0)
    squared = ((before - 2.0 * now + after) * pixels[:, None]).square().sum(1)
    dynamic_fraction = (~inputs.view.static_mask).float().mean()
    return (squared / (squared + 1.0).sqrt()).mean() * dynamic_fraction
