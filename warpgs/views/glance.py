"""What is kept of every view before training: enough for the steps that look at all of them, without their pixels."""

import zlib
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.dynamic_regions import DynamicCounts, dynamic_counts

from .pixels import Pixels

WIDTH = 64
"""Width of the small image [px], at which a few pixels of camera motion do not matter."""


class Glance(NamedTuple):
    """A view at a glance, in some tens of kilobytes of host memory.

    Attributes:
        colors: [h, w, 3] 8-bit RGB of the small image, with jumps of exposure.
        is_static: [h, w] true where all of a small pixel is static.
        counts: Of the dynamic pixels, without depth.
        has_depth: Whether its inverse depth is known anywhere, before objects get one.
        size: (width, height) of the view [px].
        packed_mask: Its static mask, compressed.
    """

    colors: UInt8[np.ndarray, "h w 3"]
    is_static: Bool[np.ndarray, "h w"]
    counts: DynamicCounts
    has_depth: bool
    size: tuple[int, int]
    packed_mask: bytes

    @property
    def static_mask(self) -> Bool[Tensor, "H W"]:
        """[H, W] true where static."""
        width, height = self.size
        bits = np.frombuffer(zlib.decompress(self.packed_mask), np.uint8)
        return torch.from_numpy(np.unpackbits(bits, count=width * height).view(bool).reshape(height, width))


def glance_at(pixels: Pixels, camera: Camera) -> Glance:
    """The glance at a view, from its pixels in host memory and its camera."""
    width, height = camera.size
    small = (min(WIDTH, width), max(1, round(height * min(WIDTH, width) / width)))
    mask = pixels.static_mask.numpy()
    static = cv2.resize(mask.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    return Glance(
        cv2.resize(pixels.image.numpy(), small, interpolation=cv2.INTER_AREA),
        static >= 1.0,
        dynamic_counts(pixels.static_mask, camera),
        not bool(pixels.inverse_depth.isnan().all()),
        (width, height),
        zlib.compress(np.packbits(mask).data, 1),
    )
