"""Truth beside render: an image of the capture as the browser's camera sees it, up to a vertical border."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera

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


def turned(
    image: UInt8[np.ndarray, "h w 3"], taken: Camera, camera: Camera
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """An image as a camera at the same place sees it.

    Args:
        image: Image of ``taken``.
        taken: Camera that recorded it.
        camera: Camera to show it through, at the same place, with any direction, lens and size.

    Returns:
        The image, and which of its pixels the given image has.
    """
    mapping = _matrix(taken.K) @ _matrix(taken.viewmat)[:3, :3]
    mapping = mapping @ np.linalg.inv(_matrix(camera.K) @ _matrix(camera.viewmat)[:3, :3])
    corner = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV has pixel centres at integers
    mapping = np.linalg.inv(corner) @ mapping @ corner
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    inside = cv2.warpPerspective(np.full(image.shape[:2], 255, np.uint8), mapping, camera.size, flags=flags)
    shown = cv2.warpPerspective(image, mapping, camera.size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return shown.astype(np.uint8), inside > 127


def wiped(
    rendered: UInt8[np.ndarray, "H W 3"],
    truth: tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]],
    fraction: float,
) -> UInt8[np.ndarray, "H W 3"]:
    """A render whose left part shows the truth.

    Args:
        rendered: The render.
        truth: Result of ``turned``; the width that it covers is divided.
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


def _matrix(tensor: Float[Tensor, "n n"]) -> Float[np.ndarray, "n n"]:
    return tensor.cpu().double().numpy()


def with_truth(image: Image, request: RenderRequest, training: TrainingCameras | None) -> Image:
    """An image with the part of the training image that its request asks for."""
    if request.truth is None or training is None:
        return image
    index, fraction = request.truth
    truth = training.image(index)
    if truth is None:
        return image
    camera = camera_of(request.pose, (image.shape[1], image.shape[0]), request.time)
    return wiped(image, turned(truth, training.camera(index), camera), fraction)
