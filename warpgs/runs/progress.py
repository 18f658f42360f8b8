"""The progress of a training, for its log and for callbacks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from warpgs.data.capture import Capture

from .trained import TrainedScene


class Status(NamedTuple):
    """Progress of a run at one of the regular checks.

    Attributes:
        iteration: Iterations done.
        stage: Name of the stage.
        loss: Mean since the last check.
        psnr: PSNR of the joint training image, mean since the last check [dB].
        terms: Each loss term, weighted, mean since the last check; without those that were off.
        num_static: Number of static Gaussians.
        num_dynamic: Number of dynamic Gaussians.
    """

    iteration: int
    stage: str
    loss: float
    psnr: float
    terms: dict[str, float]
    num_static: int
    num_dynamic: int


@dataclass(frozen=True)
class Progress:
    """What a callback of ``train`` is given.

    Attributes:
        status: Iteration, stage, loss, PSNR and numbers of Gaussians.
        num_iterations: Total iterations of the run.
        scene: The scene as it is trained now, to render; it changes as soon as training goes on.
        capture: The capture that it is trained on.
    """

    status: Status
    num_iterations: int
    scene: TrainedScene
    capture: Capture


Callback = Callable[[Progress], object]
"""Called every 50 iterations and at checkpoints, off the clock; training stops if it returns true."""
