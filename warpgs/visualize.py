"""Images for people to look at: error and depth in colours, comparisons with the truth."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from .rendering import Rendering

ERROR_RANGE = 0.25
"""Mean absolute error that has the brightest colour."""

DEPTH_PERCENTILES = (2.0, 98.0)
"""Inverse depths of an image that have the first and the last colour."""

CAPTION_HEIGHT = 18
"""Height of the bar with a caption [px]."""


def to_bytes(image: Float[Tensor, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
    """8-bit channels of an image in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def error_image(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute error of each pixel in colours, black for zero, brightest from ``ERROR_RANGE`` on."""
    error = (image - truth).abs().mean(-1).div(ERROR_RANGE)
    level = (error.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
    return _colored(level, cv2.COLORMAP_INFERNO)


def depth_bounds(inverse_depths: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """Inverse depths that have the first and the last colour: ``DEPTH_PERCENTILES``; (0, 1) without any depth."""
    if not len(inverse_depths):
        return 0.0, 1.0
    low, high = np.percentile(inverse_depths, DEPTH_PERCENTILES)
    return float(low), float(high)


def depth_image(
    inverse_depth: Float[np.ndarray, "H W"], unknown: int = 0, bounds: tuple[float, float] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Inverse depth in colours, from blue (far) to red (near).

    Args:
        inverse_depth: [H, W], not finite where unknown.
        unknown: Grey level of unknown pixels.
        bounds: Inverse depths that have the first and the last colour; ``depth_bounds`` of the image if None.
    """
    known = np.isfinite(inverse_depth)
    if not known.any():
        return np.full((*known.shape, 3), unknown, np.uint8)
    low, high = depth_bounds(inverse_depth[known]) if bounds is None else bounds
    # The lower bound of the range gives a wall at one depth one colour instead of noise.
    level = np.clip((np.where(known, inverse_depth, low) - low) / max(high - low, 1e-6), 0, 1)
    image = _colored((level * 255).round().astype(np.uint8), cv2.COLORMAP_TURBO)
    image[~known] = unknown
    return image


def reduced(image: UInt8[np.ndarray, "H W 3"], max_width: int) -> UInt8[np.ndarray, "h w 3"]:
    """An image scaled down to at most ``max_width`` pixels in width."""
    height, width = image.shape[:2]
    if width <= max_width:
        return image
    size = (max_width, max(1, round(height * max_width / width)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _colored(level: UInt8[np.ndarray, "H W"], colormap: int) -> UInt8[np.ndarray, "H W 3"]:
    return cv2.cvtColor(cv2.applyColorMap(level, colormap), cv2.COLOR_BGR2RGB)


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
