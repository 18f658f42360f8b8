"""What watches a training: callbacks of the user, held-out views for TensorBoard, and previews for the viewer."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.data.capture import Capture, Frame
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.errors import one_line
from warpgs.evaluation.image_quality import psnr
from warpgs.runs import preview
from warpgs.runs.logger import Status, TrainingLogger
from warpgs.runs.trained import TrainedScene
from warpgs.visualize.images import reduced, to_bytes

HELD_OUT_TIMES = 20
"""How often held-out views are rendered in a run."""

HELD_OUT_VIEWS = 3
HELD_OUT_WIDTH = 320
"""Width of their images in TensorBoard [px]."""

PREVIEW_SECONDS = 2.0
"""Minimum time between previews [s]."""

PREVIEW_OVERHEAD = 10.0
"""Minimum time between previews, relative to the time that writing one takes."""


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


@torch.no_grad()
def render_and_compare(scene: TrainedScene, frame: Frame) -> tuple[Float[Tensor, "H W 3"], float]:
    """The joint image of a frame's camera, and its PSNR [dB]."""
    image = scene.render(frame.camera).joint.image.clamp(0, 1)
    return image, psnr(image, frame.image.to(image.device).float() / 255.0)


class HeldOut:
    """Adds PSNR and images of a few evaluation views to TensorBoard, seldom; a callback.

    Cameras are not aligned to the scene as in the final evaluation, so that PSNR is lower where poses are corrected.
    """

    def __init__(self, logger: TrainingLogger) -> None:
        self._logger, self._next = logger, 0
        self._has_truth = self._failed = False

    @torch.no_grad()
    def __call__(self, progress: Progress) -> None:
        iteration, total = progress.status.iteration, progress.num_iterations
        names = progress.capture.val
        if not names or self._failed or (iteration < self._next and iteration < total):
            return
        self._next = iteration + max(1, total // HELD_OUT_TIMES)
        values = []
        try:
            frames = [progress.capture.frame(names[k]) for k in evenly_spaced_indices(len(names), HELD_OUT_VIEWS)]
        except (ValueError, OSError) as error:
            self._logger.log(f"warning: without held-out views in TensorBoard: {one_line(error)}")
            self._failed = True
            return
        for frame in frames:
            image, value = render_and_compare(progress.scene, frame)
            values.append(value)
            self._logger.add_image(f"held-out/{frame.name}", reduced(to_bytes(image), HELD_OUT_WIDTH), iteration)
            if not self._has_truth:
                self._logger.add_image(
                    f"held-out/{frame.name}, truth", reduced(frame.image.numpy(), HELD_OUT_WIDTH), iteration
                )
        self._has_truth = True
        self._logger.add_scalar("psnr/held-out", sum(values) / len(values), iteration)


class Previewer:
    """Writes the scene for a viewer of the run folder, while one asks for it; a callback."""

    def __init__(self, folder: Path, logger: TrainingLogger) -> None:
        self._folder, self._logger = folder, logger
        self._next = 0.0
        self._before: tuple[int, float] | None = None

    def __call__(self, progress: Progress) -> None:
        status, now = progress.status, time.monotonic()
        before, self._before = self._before, (status.iteration, now)
        if now < self._next or not preview.is_requested(self._folder):
            return
        iterations, seconds = (status.iteration - before[0], now - before[1]) if before else (0, 0.0)
        rate = iterations / seconds if seconds > 0 else None
        state = preview.State(status.iteration, progress.num_iterations, status.psnr, rate)
        try:
            preview.write(self._folder, progress.scene, state)
        except OSError as error:  # training goes on without
            self._logger.log(f"warning: no previews for the viewer: {one_line(error)}")
            self._next = math.inf
            return
        self._next = now + max(PREVIEW_SECONDS, PREVIEW_OVERHEAD * (time.monotonic() - now))
