"""Truth beside render: an image of the capture as the browser's camera sees it, up to a vertical border."""

import numpy as np
from jaxtyping import Bool, UInt8

from warpgs.cameras import Camera
from warpgs.visualize.images import seen_from

from .layers import Image
from .pose import camera_of
from .renderer import RenderRequest
from .training_cameras import TrainingCameras

MAX_DISTANCE = 1e-3
"""Distance from a training camera, relative to the median depth of the capture, up to which its image can be
shown: there, parallax is at most a thousandth of the focal length."""

BORDER = 2
"""Width of the border between truth and render [px]."""


def is_beside(camera: Camera, other: Camera, median_depth: float) -> bool:
    """Whether two cameras are at the same place, so that the image of one can be turned into that of the other."""
    return float((camera.position - other.position).norm()) <= MAX_DISTANCE * median_depth


def wiped(
    rendered: UInt8[np.ndarray, "H W 3"],
    truth: tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]],
    fraction: float,
) -> UInt8[np.ndarray, "H W 3"]:
    """A render whose left part shows the truth.

    Args:
        rendered: The render.
        truth: Result of ``seen_from``; the width that it covers is divided.
        fraction: Part of that width that shows the truth, in [0, 1].
    """
    image, inside = truth
    columns = np.flatnonzero(inside.any(0))
    if not len(columns):
        return rendered
    border = round(columns[0] + fraction * (columns[-1] + 1 - columns[0]))
    shown = inside & (np.arange(inside.shape[1]) < border)
    result = np.where(shown[..., None], image, rendered)
    result[:, max(0, border - BORDER // 2) : border + BORDER // 2] = 255
    return result


def with_truth(image: Image, request: RenderRequest, training: TrainingCameras | None) -> Image:
    """An image with the part of the training image that its request asks for."""
    if request.truth is None or training is None:
        return image
    index, fraction = request.truth
    truth = training.image(index)
    if truth is None:
        return image
    camera = camera_of(request.pose, (image.shape[1], image.shape[0]), request.time)
    return wiped(image, seen_from(camera, truth, training.camera(index)), fraction)
