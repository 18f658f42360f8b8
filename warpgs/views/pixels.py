"""The pixels of a view: the one form in which a frame is kept for training."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float16, UInt8
from torch import Tensor

BYTES_PER_PIXEL = 3 + 1 + 2
"""Memory of a view per pixel [bytes]: 8-bit RGB, mask, depth in half precision; the border of the mask is one more."""


class Pixels(NamedTuple):
    """The pixels of a view, in host memory or on the device; all T views of one size have T as a leading axis.

    Attributes:
        image: [H, W, 3] 8-bit RGB, with jumps of exposure.
        static_mask: [H, W] true where static.
        inverse_depth: [H, W] inverse depth up to a scale and an offset, NaN where unknown.
        mask_border: [H, W] true within the margin of a border of the mask; None without a margin.
    """

    image: UInt8[Tensor, "*T H W 3"]
    static_mask: Bool[Tensor, "*T H W"]
    inverse_depth: Float16[Tensor, "*T H W"]
    mask_border: Bool[Tensor, "*T H W"] | None

    def map(self, function: Callable[[Tensor], Tensor]) -> "Pixels":
        """Applies a function to every tensor."""
        return Pixels._make(None if tensor is None else function(tensor) for tensor in self)

    def copy_(self, other: "Pixels") -> None:
        """Copies the values of another view of this size; from pinned memory without waiting."""
        for old, new in zip(self, other, strict=True):
            if old is not None and new is not None:
                old.copy_(new, non_blocking=True)

    def shapes(self) -> list[torch.Size | None]:
        """The shape of every tensor."""
        return [None if tensor is None else tensor.shape for tensor in self]


def mask_border(static_mask: Bool[Tensor, "H W"], margin: int) -> Bool[Tensor, "H W"]:
    """True in pixels that have both static and dynamic pixels within ``margin`` columns and rows."""
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    static, dynamic = (cv2.dilate(mask.numpy().astype(np.uint8), kernel) for mask in (static_mask, ~static_mask))
    return torch.from_numpy(static & dynamic).bool()
