"""Optical flow (DIS, Kroeger et al. 2016) between two frames of a capture."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from .capture import Frame

MIN_SIDE, MAX_ASPECT = 16, 16
"""Minimum side [px] and maximum ratio of the sides: OpenCV's optical flow crashes on images beyond them."""


def flow_between(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "H W 2"], Bool[np.ndarray, "H W"]]:
    """Optical flow (DIS) from one grey image to another, and whether the flow back is its opposite at its end.

    Up to a pixel and 5 % of its length. Both sides of the images are at least ``MIN_SIDE``.
    """
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward, backward = method.calc(first, second, None), method.calc(second, first, None)
    height, width = first.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    far = (1e4,) * 4
    target = x + forward[..., 0], y + forward[..., 1]
    returned = cv2.remap(backward, *target, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=far)
    return forward, np.linalg.norm(forward + returned, axis=-1) < 1.0 + 0.05 * np.linalg.norm(forward, axis=-1)


def grey_at(frame: Frame, size: tuple[int, int]) -> UInt8[np.ndarray, "H W"]:
    """A frame in grey levels with even contrast, as optical flow wants it, resized to (width, height)."""
    return even_contrast(grey_levels(frame, size))


def grey_levels(frame: Frame, size: tuple[int, int]) -> UInt8[np.ndarray, "H W"]:
    """A frame in grey levels, resized to (width, height)."""
    return cv2.resize(cv2.cvtColor(frame.image.numpy(), cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)


def even_contrast(plane: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Grey levels with local contrast equalized (CLAHE), so that dark regions count as much as bright ones."""
    return cv2.createCLAHE(2.0, (8, 8)).apply(plane)
