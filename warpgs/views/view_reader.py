"""The pixels of views, read before they are needed and copied to the device while the previous step runs."""

from collections.abc import Callable

import torch
from torch import Tensor

from warpgs.data.capture import MASKS_REMEDY, Capture

from .pixels import Pixels, mask_border
from .view_cache import ViewCache

Change = Callable[[Tensor, Tensor], Tensor]
"""A new inverse depth, from the old one and the static mask, both [H, W]."""


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
        self._changed_depth: dict[int, tuple[Tensor, int]] = {}  # of views for which the disk has no space
        self._later: dict[int, list[Change]] = {}
        self.cache: ViewCache | None = None

    def read(self, index: int) -> Pixels:
        """The pixels of the view of an index; several threads may read at once.

        Raises:
            ValueError: If the frame is damaged or has no mask; the message names it.
        """
        pixels, _ = self._pixels(index)
        return pixels.map(Tensor.pin_memory) if self._pinned else pixels

    def read_once(self, index: int, keep: bool) -> Pixels:
        """As ``read``, into memory that is not pinned; ``keep``: whether to store it in the cache."""
        return self._pixels(index, pinned=False, keep=keep)[0]

    def change_depth_later(self, index: int, change: Change) -> None:
        """As ``change_depth``, once, when the view is read next: by a thread, while others do something else."""
        self._later[index] = [*self._later.get(index, []), change]

    def change_depth(self, index: int, change: Change) -> None:
        """Replaces the inverse depth of a view by a function of it and of the mask, in the cache if that has space.

        Called by one thread at a time for each view. Others may read meanwhile: what they begin to read afterwards has
        the new depth.
        """
        pixels, version = self._pixels(index, keep=False)
        pixels = _with_depth(pixels, change)
        self._changed_depth[index] = pixels.inverse_depth, version
        if self.cache and self.cache.store(index, pixels, version, replace=True):
            del self._changed_depth[index]

    def _pixels(self, index: int, pinned: bool | None = None, keep: bool = True) -> tuple[Pixels, int]:
        """The pixels of a view, and how many changes of ``change_depth_later`` they have."""
        pinned, later = self._pinned if pinned is None else pinned, self._later.get(index, [])
        stored = self.cache.load(index, pinned) if self.cache else None
        pixels, version = (self._decoded(index), 0) if stored is None else stored
        if (changed := self._changed_depth.get(index)) is not None and changed[1] >= version:
            pixels, version = pixels._replace(inverse_depth=changed[0]), changed[1]
        for change in later[version:]:
            pixels = _with_depth(pixels, change)
        if self.cache and keep and (stored is None or version < len(later)):
            self.cache.store(index, pixels, len(later))
        return pixels, len(later)

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


def _with_depth(pixels: Pixels, change: Change) -> Pixels:
    depth = change(pixels.inverse_depth.float(), pixels.static_mask).half()
    return pixels._replace(inverse_depth=depth)


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
