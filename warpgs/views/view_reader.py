"""The pixels of views, read before they are needed and copied to the device while the previous step runs."""

from collections.abc import Callable

import torch
from torch import Tensor

from warpgs.data.capture import MASKS_REMEDY, Capture

from .pixels import Pixels, mask_border
from .view_cache import ViewCache


class ViewReader:
    """Reads training views from a capture into host memory.

    Args:
        capture: Source of the frames.
        mask_margin: Half width of the borders of masks; see ``Views``.
        pinned: Whether to read into pinned memory, from which CUDA copies without waiting.

    Attributes:
        cache: The file of decoded views; None if they are read only once.
    """

    def __init__(self, capture: Capture, mask_margin: float, pinned: bool) -> None:
        self._capture, self._mask_margin, self._pinned = capture, mask_margin, pinned
        self._changed_depth: dict[int, Tensor] = {}  # of views for which the disk has no space
        self.cache: ViewCache | None = None

    def read(self, index: int) -> Pixels:
        """The pixels of the view of an index; several threads may read at once.

        Raises:
            ValueError: If the frame is damaged or has no mask; the message names it.
        """
        pixels = self._pixels(index)
        return pixels.map(Tensor.pin_memory) if self._pinned else pixels

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
    """The pixels of one view on the device, at addresses that stay the same as long as its size does.

    On CUDA a view is copied twice: on a stream of its own from the host, while the previous step runs, and then on
    the device to where the graph of a step reads it, in microseconds. So the host is at most one step ahead.

    Attributes:
        pixels: The pixels that were filled in last.
    """

    pixels: Pixels

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._arriving: Pixels | None = None
        if device.type == "cuda":
            self._stream, self._was_taken = torch.cuda.Stream(device), torch.cuda.Event()

    def fill(self, pixels: Pixels) -> None:
        """Replaces the pixels, in the order of the current stream.

        Args:
            pixels: In host memory, which is pinned if the host is not to wait.
        """
        if self._device.type != "cuda":
            self.pixels = pixels
            return
        main = torch.cuda.current_stream(self._device)
        if self._arriving is None or self._arriving.shapes() != pixels.shapes():
            self._arriving, self.pixels = pixels.map(self._empty_like), pixels.map(self._empty_like)
            self._stream.wait_stream(main)  # on which earlier work may still use this memory
        self._was_taken.synchronize()
        with torch.cuda.stream(self._stream):
            self._arriving.copy_(pixels)
        main.wait_stream(self._stream)
        self.pixels.copy_(self._arriving)
        self._was_taken.record(main)

    def _empty_like(self, tensor: Tensor) -> Tensor:
        return torch.empty_like(tensor, device=self._device)
