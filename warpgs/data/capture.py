"""A capture: posed pictures of a moving scene, read frame by frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera

MIN_EXTENT = 0.05
"""Keeps the rates of training above zero where the camera hardly moves; captures are normalised to about [-1, 1]."""


@dataclass(frozen=True)
class Frame:
    """One picture with all that is known of it, on the CPU.

    Attributes:
        name: Its id in the capture.
        camera: Undistorted pinhole camera in scene units, with the frame's time in [0, 1].
        image: [H, W, 3] 8-bit RGB.
        static_mask: [H, W] true where the scene is static; None where the capture has no masks.
        inverse_depth: [H, W] inverse depth up to a scale and an offset of this frame, NaN where unknown; None without.
        covisible: [H, W] true where masked metrics look (iPhone captures); None without.
    """

    name: str
    camera: Camera
    image: UInt8[Tensor, "H W 3"]
    static_mask: Bool[Tensor, "H W"] | None = None
    inverse_depth: Float[Tensor, "H W"] | None = None
    covisible: Bool[Tensor, "H W"] | None = None


class Capture:
    """A capture in scene units: positions are (p − center) · scale of the files.

    Attributes:
        name: For messages and reports.
        train, val: Ids of the frames to train on and to evaluate on.
        cameras: The camera of each id of ``train`` and ``val``.
        points: [P, 3] sparse static points, P may be 0.
        point_colors: [P, 3] 8-bit RGB of the points; None where the capture has none.
        extent: Radius of the training cameras' positions around their mean, times 1.1, at least 0.05: the unit of
            3DGS's position learning rate and of its densification [scene units].
    """

    def __init__(
        self,
        name: str,
        cameras: dict[str, Camera],
        train: Sequence[str],
        val: Sequence[str],
        points: Float[Tensor, "P 3"],
        point_colors: UInt8[Tensor, "P 3"] | None,
        read: Callable[[str], Frame],
        cache_frames: int = 256,
    ) -> None:
        """Keeps what is given; ``read`` is called for frames that are not among the last ``cache_frames``.

        Raises:
            ValueError: If there is no frame to train on.
        """
        if not train:
            raise ValueError(f"{name} has no frames to train on")
        self.name = name
        self.cameras = cameras
        self.train = tuple(train)
        self.val = tuple(val)
        self.points = points
        self.point_colors = point_colors
        positions = torch.stack([cameras[name].position for name in train])
        self.extent = max(MIN_EXTENT, 1.1 * float((positions - positions.mean(0)).norm(dim=1).max()))
        self._read = lru_cache(maxsize=cache_frames)(read)

    def frame(self, name: str) -> Frame:
        """Reads a frame, or takes it from the cache of the last ``cache_frames`` read.

        Raises:
            KeyError: If the capture has no frame of this id.
            ValueError: If a file of the frame is missing, damaged or of another size; the message names it.
        """
        if name not in self.cameras:
            raise KeyError(name)
        return self._read(name)
