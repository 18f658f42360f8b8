"""Images as prepare works on them: read one at a time, resized, brightened, and compared by sharpness."""

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from warpgs.data.images import decode

SHARPNESS_SIDE = 480
"""Longest side of the images that sharpness is compared on [px]: noise must not count as detail."""

MIDDLE_GREY = 0.45
"""Median lightness that dark videos are brightened to, so that dark cloth has texture."""


def read_images(folder: Path, names: Iterable[str]) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The RGB images <folder>/<name>.png, one at a time: all of them in full size may not fit into memory.

    Raises:
        ValueError: If one is missing or damaged.
    """
    for name in names:
        yield cv2.cvtColor(decode(folder / f"{name}.png"), cv2.COLOR_BGR2RGB)


def resize_to_side(
    image: UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"], side: int, max_factor: float = math.inf
) -> UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]:
    """The image scaled by at most ``max_factor`` so that its longer side has ``side`` pixels."""
    height, width = image.shape[:2]
    factor = min(max_factor, side / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC)


def brighten(images: Sequence[UInt8[np.ndarray, "H W 3"]]) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The images under one gamma curve that brings their median to middle grey."""
    middle = np.median([np.median(image[::4, ::4]) for image in images]) / 255.0
    gamma = np.clip(np.log(MIDDLE_GREY) / np.log(np.clip(middle, 0.02, 0.98)), 0.3, 1.5)
    curve = (255.0 * (np.arange(256) / 255.0) ** gamma).round().astype(np.uint8)
    return [cv2.LUT(image, curve) for image in images]


def sharpness(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """Variance of the Laplacian of an image's grey levels (Pech-Pacheco et al. 2000)."""
    return grey_sharpness(cv2.cvtColor(resize_to_side(image, SHARPNESS_SIDE, max_factor=1.0), cv2.COLOR_RGB2GRAY))


def grey_sharpness(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Variance of the Laplacian of grey levels, whose longer side has at most ``SHARPNESS_SIDE`` pixels."""
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())
