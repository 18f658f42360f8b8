"""What is kept of every view before training: enough for the steps that look at all of them, without their pixels."""

import zlib
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Frame
from warpgs.data.dynamic_regions import DynamicCounts, dynamic_counts, scaled_size
from warpgs.data.optical_flow import grey_levels

from .pixels import Pixels

WIDTH = 64
"""Width of the small image [px], at which a few pixels of camera motion do not matter."""


class Glance(NamedTuple):
    """A view at a glance, in about a hundred kilobytes of host memory.

    Attributes:
        colors: [h, w, 3] 8-bit RGB of the small image, with jumps of exposure.
        is_static: [h, w] true where all of a small pixel is static.
        counts: Of the dynamic pixels, without depth.
        has_depth: Whether its inverse depth is known anywhere, before objects get one.
        size: (width, height) of the view [px].
        packed_mask: Its static mask, compressed.
        packed_grey: Where a region is dynamic, the image in grey levels at the size of the scaled mask, as PNG.
    """

    colors: UInt8[np.ndarray, "h w 3"]
    is_static: Bool[np.ndarray, "h w"]
    counts: DynamicCounts
    has_depth: bool
    size: tuple[int, int]
    packed_mask: bytes
    packed_grey: UInt8[np.ndarray, " B"] | None

    @property
    def static_mask(self) -> Bool[Tensor, "H W"]:
        """[H, W] true where static."""
        width, height = self.size
        bits = np.frombuffer(zlib.decompress(self.packed_mask), np.uint8)
        return torch.from_numpy(np.unpackbits(bits, count=width * height).view(bool).reshape(height, width))

    @property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """[h, w] grey levels of the image, at the size of the scaled mask; only where a region is dynamic."""
        assert self.packed_grey is not None
        levels = cv2.imdecode(self.packed_grey, cv2.IMREAD_UNCHANGED)
        assert levels is not None
        return levels


def glance_at(pixels: Pixels, camera: Camera) -> Glance:
    """The glance at a view, from its pixels in host memory and its camera."""
    width, height = camera.size
    small = (min(WIDTH, width), max(1, round(height * min(WIDTH, width) / width)))
    mask = pixels.static_mask.numpy()
    static = cv2.resize(mask.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    counts, grey = dynamic_counts(pixels.static_mask, camera), None
    if counts.regions:
        levels = grey_levels(Frame("", camera, pixels.image), scaled_size(camera))
        grey = cv2.imencode(".png", levels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
    return Glance(
        cv2.resize(pixels.image.numpy(), small, interpolation=cv2.INTER_AREA),
        static >= 1.0,
        counts,
        not bool(pixels.inverse_depth.isnan().all()),
        (width, height),
        zlib.compress(np.packbits(mask).data, 1),
        grey,
    )
