"""Views as they are stored, read before they are needed and copied to the device while the previous step runs."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, UInt8
from torch import Tensor

from warpgs.data.capture import MASKS_REMEDY, Capture

from .view_cache import Pixels, ViewCache

BYTES_PER_PIXEL = 3 + 1 + 2
"""Memory of a view per pixel [bytes]: 8-bit RGB, mask, depth in half precision; the border of the mask is one more."""


class StoredView(NamedTuple):
    """A view as it is stored, in host memory or on the device; all T views of one size have T as a leading axis.

    Attributes:
        viewmat: [4, 4] world-to-camera transform of the capture, without correction; translation in scene units.
        K: [3, 3] intrinsics [px].
        time: [1] time in [0, 1].
        image: [H, W, 3] 8-bit RGB, with jumps of exposure.
        static_mask: [H, W] true where static.
        inverse_depth: [H, W] inverse depth up to a scale and an offset, NaN where unknown.
        mask_border: [H, W] true within the margin of a border of the mask; None without a margin.
        gain: [3] what the image in [0, 1] is divided by, per channel; None if nothing is.
    """

    viewmat: Float32[Tensor, "*T 4 4"]
    K: Float32[Tensor, "*T 3 3"]
    time: Float32[Tensor, "*T 1"]
    image: UInt8[Tensor, "*T H W 3"]
    static_mask: Bool[Tensor, "*T H W"]
    inverse_depth: Float16[Tensor, "*T H W"]
    mask_border: Bool[Tensor, "*T H W"] | None
    gain: Float32[Tensor, "*T 3"] | None

    def map(self, function: Callable[[Tensor], Tensor]) -> "StoredView":
        """Applies a function to every tensor."""
        return StoredView._make(None if tensor is None else function(tensor) for tensor in self)

    def copy_(self, other: "StoredView") -> None:
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


class ViewReader:
    """Reads training views from a capture into host memory.

    Args:
        capture: Source of the frames.
        mask_margin: Half width of the borders of masks; see ``Views``.
        pinned: Whether to read into pinned memory, from which CUDA copies without waiting.

    Attributes:
        cache: The file of decoded views; None if they are read only once.
        gains: [T, 3] what images are divided by, per channel; nothing if None.
    """

    def __init__(self, capture: Capture, mask_margin: float, pinned: bool) -> None:
        self._capture, self._mask_margin, self._pinned = capture, mask_margin, pinned
        self._changed_depth: dict[int, Tensor] = {}  # of views for which the disk has no space
        self.cache: ViewCache | None = None
        self.gains: Float[Tensor, "T 3"] | None = None

    def read(self, index: int) -> StoredView:
        """The view of an index; several threads may read at once.

        Raises:
            ValueError: If the frame is damaged or has no mask; the message names it.
        """
        pixels = self._pixels(index)
        camera = self._capture.cameras[self._capture.train[index]]
        time = torch.tensor([camera.time], dtype=torch.float32)
        gain = None if self.gains is None else self.gains[index]
        stored = StoredView(camera.viewmat, camera.K, time, *pixels, gain)
        return stored.map(Tensor.pin_memory) if self._pinned else stored

    def change_depth(self, index: int, change: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Replaces the inverse depth of a view by a function of it and of the mask, in the cache if that has space.

        Called by one thread at a time. Others may read meanwhile: what they begin to read afterwards has the new depth.
        """
        pixels = self._pixels(index)
        depth = change(pixels.inverse_depth.float(), pixels.static_mask).half()
        self._changed_depth[index] = depth
        if self.cache and self.cache.store(index, pixels._replace(inverse_depth=depth), replace=True):
            del self._changed_depth[index]

    def _pixels(self, index: int) -> Pixels:
        pixels = self.cache.load(index, self._pinned) if self.cache else None
        if pixels is None:
            pixels = self._decoded(index)
            if self.cache:
                self.cache.store(index, pixels)
        depth = self._changed_depth.get(index)
        return pixels if depth is None else pixels._replace(inverse_depth=depth)

    def _decoded(self, index: int) -> Pixels:
        frame = self._capture.frame(self._capture.train[index])
        size = frame.image.shape[:2]
        if frame.static_mask is None:
            raise ValueError(
                f"{self._capture.name}: frame {frame.name} has no mask of the dynamic region, which training needs; "
                f"make masks {MASKS_REMEDY}"
            )
        depth = torch.full(size, torch.nan, dtype=torch.float32) if frame.inverse_depth is None else frame.inverse_depth
        margin = round(self._mask_margin * max(size))
        is_exact = frame.empty is not None and self._capture.assumption == "dynamic"
        border = mask_border(frame.static_mask, 0 if is_exact else margin) if margin else None
        return Pixels(frame.image, frame.static_mask, depth.half(), border)


class Slot:
    """One view on the device, at addresses that stay the same as long as its size does.

    On CUDA a view is copied twice: on a stream of its own from the host, while the previous step runs, and then on
    the device to where the graph of a step reads it, in microseconds. So the host is at most one step ahead.

    Attributes:
        view: The view that was filled in last.
    """

    view: StoredView

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._arriving: StoredView | None = None
        if device.type == "cuda":
            self._stream, self._was_taken = torch.cuda.Stream(device), torch.cuda.Event()

    def fill(self, view: StoredView) -> None:
        """Replaces the view, in the order of the current stream.

        Args:
            view: In host memory, which is pinned if the host is not to wait.
        """
        if self._device.type != "cuda":
            self.view = view
            return
        main = torch.cuda.current_stream(self._device)
        if self._arriving is None or self._arriving.shapes() != view.shapes():
            self._arriving, self.view = view.map(self._empty_like), view.map(self._empty_like)
            self._stream.wait_stream(main)  # on which earlier work may still use this memory
        self._was_taken.synchronize()
        with torch.cuda.stream(self._stream):
            self._arriving.copy_(view)
        main.wait_stream(self._stream)
        self.view.copy_(self._arriving)
        self._was_taken.record(main)

    def _empty_like(self, tensor: Tensor) -> Tensor:
        return torch.empty_like(tensor, device=self._device)
