"""What is kept of every view before training: enough for the steps that look at all of them, without their pixels."""

import math
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Frame
from warpgs.data.dynamic_regions import DynamicCounts, dynamic_counts, dynamic_regions, scaled_size
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
        packed_regions: Its ``dynamic_regions``, compressed.
        packed_grey: Where a region is dynamic, the image in grey levels at the size of the scaled mask, as PNG.
    """

    colors: UInt8[np.ndarray, "h w 3"]
    is_static: Bool[np.ndarray, "h w"]
    counts: DynamicCounts
    has_depth: bool
    size: tuple[int, int]
    packed_mask: bytes
    packed_regions: bytes
    packed_grey: UInt8[np.ndarray, " B"] | None

    @property
    def static_mask(self) -> Bool[Tensor, "H W"]:
        """[H, W] true where static."""
        return torch.from_numpy(_unpacked(self.packed_mask, 1, self.size)[0])

    @property
    def regions(self) -> list[Bool[np.ndarray, "h w"]]:
        """The ``dynamic_regions``, [h, w] at the size of the scaled mask."""
        return [*_unpacked(self.packed_regions, self.counts.regions, scaled_size(self.size))]

    @property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """[h, w] grey levels of the image, at the size of the scaled mask; only where a region is dynamic."""
        assert self.packed_grey is not None
        levels = cv2.imdecode(self.packed_grey, cv2.IMREAD_UNCHANGED)
        assert levels is not None
        return levels


def _packed(masks: Sequence[Bool[np.ndarray, "h w"]]) -> bytes:
    return zlib.compress(np.packbits(np.array(masks, bool)).data, 1)


def _unpacked(packed: bytes, count: int, size: tuple[int, int]) -> Bool[np.ndarray, "count h w"]:
    shape = (count, size[1], size[0])
    bits = np.unpackbits(np.frombuffer(zlib.decompress(packed), np.uint8), count=math.prod(shape))
    return bits.view(bool).reshape(shape)


def glance_at(pixels: Pixels, camera: Camera) -> Glance:
    """The glance at a view, from its pixels in host memory and its camera."""
    width, height = camera.size
    small = (min(WIDTH, width), max(1, round(height * min(WIDTH, width) / width)))
    mask = pixels.static_mask.numpy()
    static = cv2.resize(mask.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    regions, grey = dynamic_regions(pixels.static_mask, camera), None
    if regions:
        levels = grey_levels(Frame("", camera, pixels.image), scaled_size(camera.size))
        grey = cv2.imencode(".png", levels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
    return Glance(
        cv2.resize(pixels.image.numpy(), small, interpolation=cv2.INTER_AREA),
        static >= 1.0,
        dynamic_counts(pixels.static_mask, regions),
        not bool(pixels.inverse_depth.isnan().all()),
        (width, height),
        _packed([mask]),
        _packed(regions),
        grey,
    )
