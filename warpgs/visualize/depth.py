"""Inverse depth in colours, for people to look at; needs no torch."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

PERCENTILES = (2.0, 98.0)
"""Inverse depths of an image that have the first and the last colour."""

MIN_RANGE = 1e-6
"""Minimum range of the colours, relative to the nearest depth: a wall at one depth has one colour instead of noise."""


def depth_bounds(inverse_depths: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """Inverse depths that have the first and the last colour: ``PERCENTILES``; (0, 1) without any depth."""
    if not len(inverse_depths):
        return 0.0, 1.0
    low, high = np.percentile(inverse_depths, PERCENTILES)
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
    span = max(high - low, MIN_RANGE * abs(high), np.finfo(np.float32).tiny)
    level = np.clip((np.where(known, inverse_depth, low) - low) / span, 0, 1)
    image = colored((level * 255).round().astype(np.uint8), cv2.COLORMAP_TURBO)
    image[~known] = unknown
    return image


def colored(level: UInt8[np.ndarray, "H W"], colormap: int) -> UInt8[np.ndarray, "H W 3"]:
    """Levels in the colours of one of OpenCV's colormaps, as RGB."""
    return cv2.cvtColor(cv2.applyColorMap(level, colormap), cv2.COLOR_BGR2RGB)
