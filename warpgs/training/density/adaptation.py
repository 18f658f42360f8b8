"""The scene that density control changes after an iteration, and everything that this may depend on."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam
from warpgs.training.schedule import IterationPlan
from warpgs.views.views import Views

MAX_PER_PIXEL = 3
"""Maximum number of Gaussians per pixel of an image: more frames show little more of a scene, but without a limit clips
of 80 frames grow until memory ends."""


@dataclass(frozen=True)
class Adaptation:
    """A change of the scene after an iteration.

    Attributes:
        scene: Changed in place, together with the moments of the optimizer.
        optimizer: From ``optimizer.make_optimizer``.
        plan: Of the iteration.
        config: Config of the run.
        capture: Its capture.
        views: Training views.
        alignments: [T, 2] scale and offset of each view's inverse depth.
        generator: The CPU generator of random numbers for a purpose at this iteration.
        log: Receives lines for the user.
    """

    scene: SplitScene
    optimizer: Adam
    plan: IterationPlan
    config: TrainConfig
    capture: Capture
    views: Views
    alignments: Float[Tensor, "T 2"]
    generator: Callable[[str], torch.Generator]
    log: Callable[[str], None]

    @property
    def capacity(self) -> int:
        """Number of Gaussians that may be added to both branches together; negative if there are too many.

        An image shows the dynamic Gaussians of its own segment alone.
        """
        config, most = self.config.densify, self.config.densify.max_gaussians
        num_static, num_dynamic = len(self.scene.static), len(self.scene.dynamic)
        if not config.min_pixels:
            return most - num_static - num_dynamic
        pixels, segments = self.views.num_pixels, self.scene.dynamic.segments
        num_shown = num_dynamic if segments is None or not num_dynamic else int(segments.bincount().max())
        room = MAX_PER_PIXEL * pixels // len(self.views) - num_static - num_shown
        return min(most - num_static - num_dynamic, pixels // config.min_pixels - num_static - num_dynamic, room)
