"""Training views on the device."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture, Frame


class View(NamedTuple):
    """One training view on the device.

    Attributes:
        camera: Its ``time`` is not to be used; the one here is on the device.
        time: [1] moment in [0, 1].
        image: [H, W, 3] in [0, 1].
        static_mask: [H, W] M of the paper, true where static.
        inverse_depth: [H, W] up to a scale and an offset, NaN where unknown.
    """

    camera: Camera
    time: Float[Tensor, "1"]
    image: Float[Tensor, "H W 3"]
    static_mask: Bool[Tensor, "H W"]
    inverse_depth: Float[Tensor, "H W"]


class _Stored(NamedTuple):
    """Views as they are kept: bytes for images, half precision for depth. Tensors may have a first axis for views."""

    viewmat: Tensor
    K: Tensor
    time: Tensor
    image: Tensor
    static_mask: Tensor
    inverse_depth: Tensor


class Views:
    """The training frames of a capture.

    Frames of one size that fit into ``resident_bytes`` are all kept on the device, as bytes; a view is then picked by
    an index that is on the device, too, so that picking can be part of a CUDA graph. Otherwise each is read from the
    capture when it is wanted.

    Args:
        capture: Where the frames come from.
        device: Where views are wanted.
        resident_bytes: Memory for kept views.
        assume: "masks" as the capture has them, or that all is "static" or "dynamic".

    Attributes:
        resident: Whether all views are on the device.

    Raises:
        ValueError: If a frame has no mask where masks are wanted; the message names it.
    """

    def __init__(self, capture: Capture, device: torch.device, resident_bytes: int, assume: str = "masks") -> None:
        self.device = device
        self._capture, self._assume = capture, assume
        first = self._store(capture.frame(capture.train[0]))
        sizes = {capture.cameras[name].size for name in capture.train}
        self.resident = len(sizes) == 1 and len(self) * sum(t.nbytes for t in first) <= resident_bytes
        if self.resident:
            stored = [self._store(capture.frame(name)) for name in capture.train]
            self._all = _Stored(*(torch.stack(tensors).to(device) for tensors in zip(*stored, strict=True)))

    def __len__(self) -> int:
        return len(self._capture.train)

    def __getitem__(self, index: int) -> View:
        if self.resident:
            return self._view(_Stored(*(tensors[index] for tensors in self._all)))
        stored = self._store(self._capture.frame(self._capture.train[index]))
        return self._view(_Stored(*(tensor.to(self.device) for tensor in stored)))

    def pick(self, index: Int64[Tensor, "1"]) -> View:
        """The view of an index on the device; all must be resident."""
        return self._view(_Stored(*(tensors.index_select(0, index)[0] for tensors in self._all)))

    def _view(self, stored: _Stored) -> View:
        height, width = stored.static_mask.shape
        return View(
            Camera(stored.viewmat, stored.K, width, height),
            stored.time,
            stored.image.float() / 255.0,
            stored.static_mask,
            stored.inverse_depth.float(),
        )

    def _store(self, frame: Frame) -> _Stored:
        camera, size = frame.camera, frame.image.shape[:2]
        mask = frame.static_mask
        if self._assume != "masks":
            mask = torch.full(size, self._assume == "static")
        elif mask is None:
            raise ValueError(
                f"{self._capture.name}: frame {frame.name} has no mask of what moves, which training needs; "
                "give the capture masks, or train with --assume static or --assume dynamic"
            )
        depth = torch.full(size, torch.nan) if frame.inverse_depth is None else frame.inverse_depth
        return _Stored(camera.viewmat, camera.K, torch.tensor([camera.time]), frame.image, mask, depth.half())
