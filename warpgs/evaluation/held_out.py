"""A few evaluation views during training, for TensorBoard."""

from collections.abc import Mapping
from types import MappingProxyType

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.data.capture import Frame
from warpgs.data.responses import Response, camera_responses, in_response
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.errors import one_line
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.progress import Progress
from warpgs.runs.trained import TrainedScene
from warpgs.visualize.images import reduced, to_bytes

from .image_quality import psnr

HELD_OUT_TIMES = 20
"""How often held-out views are rendered in a run."""

HELD_OUT_VIEWS = 3
HELD_OUT_WIDTH = 320
"""Width of their images in TensorBoard [px]."""


@torch.no_grad()
def render_and_compare(
    scene: TrainedScene, frame: Frame, responses: Mapping[int, Response] = MappingProxyType({})
) -> tuple[Float[Tensor, "H W 3"], float]:
    """The joint image as a frame's camera records it by its gain, and its PSNR [dB]."""
    image = in_response(scene.render(frame.camera).joint.image, frame, responses).clamp(0, 1)
    return image, psnr(image, frame.image.to(image.device).float() / 255.0, frame.camera.to(image.device).shown)


class HeldOut:
    """Adds PSNR and images of a few evaluation views to TensorBoard, seldom; a callback.

    Cameras are not aligned to the scene as in the final evaluation, so that PSNR is lower where poses are corrected.
    """

    def __init__(self, logger: TrainingLogger) -> None:
        self._logger, self._next = logger, 0
        self._has_truth = self._failed = False
        self._responses: Mapping[int, Response] | None = None

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
            if self._responses is None:
                self._responses = camera_responses(progress.capture) if progress.scene.config.exposure else {}
        except (ValueError, OSError) as error:
            self._logger.log(f"warning: without held-out views in TensorBoard: {one_line(error)}")
            self._failed = True
            return
        for frame in frames:
            image, value = render_and_compare(progress.scene, frame, self._responses)
            values.append(value)
            self._logger.add_image(f"held-out/{frame.name}", reduced(to_bytes(image), HELD_OUT_WIDTH), iteration)
            if not self._has_truth:
                self._logger.add_image(
                    f"held-out/{frame.name}, truth", reduced(frame.image.numpy(), HELD_OUT_WIDTH), iteration
                )
        self._has_truth = True
        self._logger.add_scalar("psnr/held-out", sum(values) / len(values), iteration)
