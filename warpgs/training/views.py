"""Training views on the device."""

from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import MASKS_REMEDY, Capture, Frame
from warpgs.data.resized import resize_inverse
from warpgs.model.poses import PoseCorrections


class View(NamedTuple):
    """One training view on the device.

    Attributes:
        camera: The camera. Use ``time`` instead of ``camera.time``, which is not on the device.
        time: [1] time in [0, 1].
        image: [H, W, 3] ground truth in [0, 1], without jumps of exposure if they are divided out.
        static_mask: [H, W] M of the paper, true where static.
        mask_border: [H, W] true within the margin of a border of the mask; None without a margin.
        inverse_depth: [H, W] inverse depth up to a scale and an offset, NaN where unknown.
    """

    camera: Camera
    time: Float[Tensor, "1"]
    image: Float[Tensor, "H W 3"]
    static_mask: Bool[Tensor, "H W"]
    mask_border: Bool[Tensor, "H W"] | None
    inverse_depth: Float[Tensor, "H W"]


def mask_border(static_mask: Bool[Tensor, "H W"], margin: int) -> Bool[Tensor, "H W"]:
    """True in pixels that have both static and dynamic pixels within ``margin`` columns and rows."""
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    static, dynamic = (cv2.dilate(mask.numpy().astype(np.uint8), kernel) for mask in (static_mask, ~static_mask))
    return torch.from_numpy(static & dynamic).bool()


class _Stored(NamedTuple):
    """Views as they are stored: bytes for images, half precision for depth. Tensors may have a leading view axis."""

    viewmat: Tensor
    K: Tensor
    time: Tensor
    image: Tensor
    static_mask: Tensor
    inverse_depth: Tensor
    mask_border: Tensor | None
    gain: Tensor | None

    def nbytes(self) -> int:
        """Memory of all tensors [bytes]."""
        return sum(tensor.nbytes for tensor in self if tensor is not None)

    def map(self, function: Callable[[Tensor], Tensor]) -> "_Stored":
        """Applies a function to every tensor."""
        return _Stored._make(None if tensor is None else function(tensor) for tensor in self)


class Views:
    """The training frames of a capture.

    Frames of one size that fit into ``resident_bytes`` are kept on the device. A view is then chosen by an index that
    is on the device, too, so that choosing can be part of a CUDA graph. Other frames are read from the capture on
    demand.

    Args:
        capture: Source of the frames.
        device: Device of the views.
        resident_bytes: Maximum memory for views on the device [bytes].
        mask_margin: Half width of the borders of masks, as a fraction of the image's larger side. Masks that are where
            frames are not empty have none: they are exact.
        gains: [T, 3] what images are divided by, per channel; nothing if None.
        poses: Corrections of the cameras; none if None.

    Attributes:
        poses: The corrections.
        background: Colour behind everything.
        resident: Whether all views are on the device.
        num_pixels: Number of pixels of all views.

    Raises:
        ValueError: If a frame has no mask; the message names it.
    """

    def __init__(
        self,
        capture: Capture,
        device: torch.device,
        resident_bytes: int,
        mask_margin: float = 0.0,
        gains: Float[Tensor, "T 3"] | None = None,
        poses: PoseCorrections | None = None,
    ) -> None:
        self.device, self._mask_margin = device, mask_margin
        self.poses = poses
        self._gains = {} if gains is None else dict(zip(capture.train, gains, strict=True))
        self._capture, self.background = capture, capture.background
        self._depth_changes: dict[str, list[Callable[[Tensor, Tensor], Tensor]]] = defaultdict(list)
        first = self._store(capture.frame(capture.train[0]))
        sizes = [capture.cameras[name].size for name in capture.train]
        self.num_pixels = sum(width * height for width, height in sizes)
        self.resident = len(set(sizes)) == 1 and len(self) * first.nbytes() <= resident_bytes
        if self.resident:
            stored = [self._store(capture.frame(name)) for name in capture.train]
            parts = zip(*stored, strict=True)
            self._all = _Stored._make(None if part[0] is None else torch.stack(part).to(device) for part in parts)

    def __len__(self) -> int:
        return len(self._capture.train)

    def __getitem__(self, index: int) -> View:
        if self.resident:
            stored = self._all.map(lambda tensors: tensors[index])
        else:
            stored = self._store(self._capture.frame(self._capture.train[index]))
            stored = stored.map(lambda tensor: tensor.to(self.device))
        return self._view(stored, torch.full((1,), index, device=self.device))

    def pick(self, index: Int64[Tensor, "1"]) -> View:
        """The view of an index on the device; all views must be resident."""
        return self._view(self._all.map(lambda tensors: tensors.index_select(0, index)[0]), index)

    def set_depth_factor(self, index: int, alignment: Float[Tensor, "2"], factor: Float[Tensor, "H W"]) -> None:
        """Multiplies the aligned inverse depth of a view by a factor, once; the alignment stays the same."""
        (scale, offset), factor = alignment.cpu(), factor.half().cpu()
        self._change_depth(index, lambda depth, static_mask: ((scale * depth + offset) * factor - offset) / scale)

    def set_object_depth(self, index: int, alignment: Float[Tensor, "2"], depths: Float[Tensor, "h w"]) -> None:
        """Sets the aligned depth of a view's dynamic pixels whose depth is unknown.

        Args:
            index: Of the view.
            alignment: [2] of its inverse depth; it stays the same.
            depths: [h, w] depth [scene units] of any size, NaN where unknown.
        """
        scale, offset = alignment.cpu()
        inverse = ((1.0 / depths - offset) / scale).numpy()

        def change(depth: Tensor, static_mask: Tensor) -> Tensor:
            found = resize_inverse(inverse, (depth.shape[1], depth.shape[0]))
            return torch.where(depth.isnan() & ~static_mask, torch.from_numpy(found), depth)

        self._change_depth(index, change)

    def _change_depth(self, index: int, change: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Replaces the inverse depth of a view by a function of it and of the mask, now or whenever it is read."""
        if self.resident:
            depth, static_mask = (values[index].cpu() for values in (self._all.inverse_depth, self._all.static_mask))
            self._all.inverse_depth[index] = change(depth.float(), static_mask).half()
        else:
            self._depth_changes[self._capture.train[index]].append(change)

    @torch.no_grad()
    def cameras(self) -> list[Camera]:
        """The corrected cameras of all views, on the device."""
        cameras = [self._capture.cameras[name].to(self.device) for name in self._capture.train]
        indices = torch.arange(len(self), device=self.device).split(1)
        return [self._corrected(*pair) for pair in zip(cameras, indices, strict=True)]

    def _corrected(self, camera: Camera, index: Int64[Tensor, "1"]) -> Camera:
        return camera if self.poses is None else self.poses.moved(camera, index)

    def _view(self, stored: _Stored, index: Int64[Tensor, "1"]) -> View:
        height, width = stored.static_mask.shape
        image = stored.image.float() / 255.0
        return View(
            self._corrected(Camera(stored.viewmat, stored.K, width, height), index),
            stored.time,
            image if stored.gain is None else image / stored.gain,
            stored.static_mask,
            stored.mask_border,
            stored.inverse_depth.float(),
        )

    def _store(self, frame: Frame) -> _Stored:
        camera, size = frame.camera, frame.image.shape[:2]
        if frame.static_mask is None:
            raise ValueError(
                f"{self._capture.name}: frame {frame.name} has no mask of the dynamic region, which training needs; "
                f"make masks {MASKS_REMEDY}"
            )
        depth = torch.full(size, torch.nan) if frame.inverse_depth is None else frame.inverse_depth
        depth = depth.half()
        for change in self._depth_changes.get(frame.name, ()):
            depth = change(depth.float(), frame.static_mask).half()
        time = torch.tensor([camera.time], dtype=torch.float32)
        margin = round(self._mask_margin * max(size))
        is_exact = frame.empty is not None and self._capture.assumption == "dynamic"
        border = mask_border(frame.static_mask, 0 if is_exact else margin) if margin else None
        tensors = (camera.viewmat, camera.K, time, frame.image, frame.static_mask, depth)
        return _Stored(*tensors, border, self._gains.get(frame.name))
