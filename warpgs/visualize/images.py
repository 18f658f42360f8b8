"""Images for people to look at: errors in colours, comparisons with the truth."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d

from warpgs.cameras import Camera
from warpgs.rendering import Rendering

from .depth import colored

ERROR_RANGE = 0.25
"""Mean absolute error that has the brightest colour."""

CAPTION_HEIGHT = 18
"""Height of the bar with a caption [px]."""


def to_bytes(image: Float[Tensor, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
    """8-bit channels of an image in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def error_image(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute error of each pixel in colours, black for zero, brightest from ``ERROR_RANGE`` on."""
    error = (image - truth).abs().mean(-1).div(ERROR_RANGE)
    level = (error.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
    return colored(level, cv2.COLORMAP_INFERNO)


def reduced(image: UInt8[np.ndarray, "H W 3"], max_width: int) -> UInt8[np.ndarray, "h w 3"]:
    """An image scaled down to at most ``max_width`` pixels in width."""
    height, width = image.shape[:2]
    if width <= max_width:
        return image
    size = (max_width, max(1, round(height * max_width / width)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def averaged(image: Float[Tensor, "H W C"], factor: int) -> Float[Tensor, "h w C"]:
    """An image scaled down by a whole factor."""
    if factor == 1:
        return image
    return avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)


def seen_from(
    camera: Camera, image: UInt8[np.ndarray, "h w *C"], taken: Camera
) -> tuple[UInt8[np.ndarray, "H W *C"], Bool[np.ndarray, "H W"]]:
    """An image as a camera at the same place sees it, with any direction, lens and size.

    Args:
        camera: Camera to show it through.
        image: Image of ``taken``, in colour or grey.
        taken: Camera that recorded it.

    Returns:
        The image, and which of its pixels the given image has.
    """
    camera, taken = camera.to("cpu"), taken.to("cpu")
    viewed = camera.rays(camera.pixel_centers) @ (camera.viewmat[:3, :3] @ taken.viewmat[:3, :3].T)
    positions, _, is_seen = taken.place(viewed)
    is_seen &= ((positions >= 0.0) & (positions <= torch.tensor(taken.size))).all(1)
    # OpenCV has pixel centres at integers.
    maps = (positions - 0.5).clamp(-1.0, 2.0 * max(taken.size)).reshape(camera.height, camera.width, 2).numpy()
    shown = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return shown.astype(np.uint8), is_seen.reshape(camera.height, camera.width).numpy()


def comparison(truth: Float[Tensor, "H W 3"], rendering: Rendering) -> UInt8[np.ndarray, "H2 W5 3"]:
    """truth | joint | static | dynamic | error, side by side with captions."""
    assert rendering.static is not None
    assert rendering.dynamic is not None
    images = {
        "truth": to_bytes(truth),
        "joint": to_bytes(rendering.joint.image),
        "static": to_bytes(rendering.static.image),
        "dynamic": to_bytes(rendering.dynamic.image),
        f"error (0 to {ERROR_RANGE})": error_image(rendering.joint.image.clamp(0, 1), truth),
    }
    return np.concatenate([_captioned(name, image) for name, image in images.items()], axis=1)


def _captioned(name: str, image: np.ndarray) -> np.ndarray:
    bar = np.zeros((CAPTION_HEIGHT, image.shape[1], 3), np.uint8)
    cv2.putText(bar, name, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    return np.concatenate([bar, image])
