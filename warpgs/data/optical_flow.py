"""Optical flow (DIS, Kroeger et al. 2016) between two frames of a capture."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from .capture import Frame

MIN_SIDE, MAX_ASPECT = 16, 16
"""Minimum side [px] and maximum ratio of the sides: OpenCV's optical flow crashes on images beyond them."""

RELATIVE_TOLERANCE = 0.05
"""Distance by which flow there and back may miss a pixel, relative to its displacement."""


def flow_between(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "H W 2"], Bool[np.ndarray, "H W"]]:
    """Optical flow (DIS) from one grey image to another, and whether the flow back is its opposite at its end.

    Up to a pixel, see ``follow``. Both sides of the images are at least ``MIN_SIDE``.
    """
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward, backward = method.calc(first, second, None), method.calc(second, first, None)
    return forward, follow(forward, backward, 1.0)[2]


def follow(
    forward: Float[np.ndarray, "H W 2"], backward: Float[np.ndarray, "H W 2"], tolerance: float
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Column and row to which flow leads from every pixel, and whether the flow back leads from there to the pixel.

    It may miss the pixel by ``tolerance`` [px] and by ``RELATIVE_TOLERANCE`` of the displacement.
    """
    height, width = forward.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = x + forward[..., 0], y + forward[..., 1]
    far = (1e4, 1e4, 0.0, 0.0)  # outside of the image
    returned = cv2.remap(backward, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=far)
    return x, y, _lengths(forward + returned) < tolerance + RELATIVE_TOLERANCE * _lengths(forward)


def _lengths(flow: Float[np.ndarray, "H W 2"]) -> Float[np.ndarray, "H W"]:
    return np.sqrt(flow[..., 0] ** 2 + flow[..., 1] ** 2)


def grey_levels(frame: Frame, size: tuple[int, int]) -> UInt8[np.ndarray, "H W"]:
    """A frame in grey levels, resized to (width, height)."""
    return cv2.resize(cv2.cvtColor(frame.image.numpy(), cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)


def even_contrast(plane: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Grey levels with local contrast equalized (CLAHE), so that dark regions count as much as bright ones."""
    return cv2.createCLAHE(2.0, (8, 8)).apply(plane)
