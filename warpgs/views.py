"""Training views on the device."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .cameras import Camera
from .data.capture import Capture, Frame


class View(NamedTuple):
    """One training view on the device.

    Attributes:
        camera: With its time as a float; ``time`` has it on the device.
        time: [1] moment in [0, 1].
        image: [H, W, 3] in [0, 1].
        static_mask: [H, W] M of the paper, true where static.
        inverse_depth: [H, W] up to a scale and an offset, NaN where unknown; None without.
    """

    camera: Camera
    time: Float[Tensor, "1"]
    image: Float[Tensor, "H W 3"]
    static_mask: Bool[Tensor, "H W"]
    inverse_depth: Float[Tensor, "H W"] | None


class _Stored(NamedTuple):
    """A view as it is kept: bytes for the image, half precision for depth."""

    camera: Camera
    time: Tensor
    image: Tensor
    static_mask: Tensor
    inverse_depth: Tensor | None


class Views:
    """The frames of a capture, kept on the device as bytes as long as they fit into ``resident_bytes``.

    Args:
        capture: Where the frames come from.
        names: Ids of the frames.
        device: Where views are wanted.
        resident_bytes: Memory for kept views; the rest is read from the capture each time.
        assume: "masks" as the capture has them, or that all is "static" or "dynamic".

    Raises:
        ValueError: If a frame has no mask where masks are wanted; the message names it.
    """

    def __init__(
        self,
        capture: Capture,
        names: tuple[str, ...],
        device: torch.device,
        resident_bytes: int,
        assume: str = "masks",
    ) -> None:
        self.names = names
        self._capture = capture
        self.device = device
        self._free = resident_bytes
        self._assume = assume
        self._kept: dict[int, _Stored] = {}

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> View:
        stored = self._kept.get(index)
        if stored is None:
            stored = self._store(self._capture.frame(self.names[index]))
            tensors = (stored.image, stored.static_mask, stored.inverse_depth)
            size = sum(t.numel() * t.element_size() for t in tensors if t is not None)
            if size <= self._free:
                self._free -= size
                self._kept[index] = stored
        depth = stored.inverse_depth
        return View(
            stored.camera,
            stored.time,
            stored.image.float() / 255.0,
            stored.static_mask,
            None if depth is None else depth.float(),
        )

    def _store(self, frame: Frame) -> _Stored:
        mask = frame.static_mask
        if self._assume != "masks":
            mask = torch.full(frame.image.shape[:2], self._assume == "static")
        elif mask is None:
            raise ValueError(
                f"{self._capture.name}: frame {frame.name} has no mask of what moves, which training needs; "
                "give the capture masks, or train with --assume static or --assume dynamic"
            )
        depth = frame.inverse_depth
        return _Stored(
            frame.camera.to(self.device),
            torch.tensor([frame.camera.time], device=self.device),
            frame.image.to(self.device),
            mask.to(self.device),
            None if depth is None else depth.to(self.device, torch.float16),
        )
