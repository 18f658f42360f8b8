"""Options of ``warpgs prepare``. Imports nothing heavy, so that the command line starts quickly."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

LensModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
"""COLMAP's lens models that a capture's cameras can represent."""

CameraMotion = Literal["moving", "turning", "still"]
"""How the camera moves: to other places, only in its direction, or not at all."""

MIN_FRAMES = 5
MAX_FRAMES = 1000
"""Minimum and maximum number of frames of a capture; more take more memory than they are worth."""


@dataclass(frozen=True)
class Selection:
    """Which frames to take from a source, and their size.

    Attributes:
        fps: Frames per second of a video; None to use ``count``.
        count: Number of frames; None for all frames of a folder and 150 of a video.
        longest_side: Larger frames are scaled down to it [px].
        start, end: Part of a video to take them from [s from its first frame]; None for its end.
    """

    fps: float | None = None
    count: int | None = None
    longest_side: int = 960
    start: float = 0.0
    end: float | None = None


@dataclass(frozen=True)
class Options:
    """How to make a capture from a source.

    Attributes:
        selection: Frames to take.
        lens: COLMAP's lens model.
        focal: Known focal length [px of the source]; None to find it.
        intrinsics: File of the known lens, see ``intrinsics``; None to find it.
        camera: How the camera moves.
        masks: A name in ``masks.MASKERS``, or a folder of masks, 0 = dynamic.
        depth: A name in ``depth.DEPTHS``; None for "flow", or "none" of a camera that stays at one place.
        holdout: Every N-th frame is kept for evaluation; 0 for none.
        weights: Folder with the weights of the networks; None for the Hugging Face cache.
    """

    selection: Selection = field(default_factory=Selection)
    lens: LensModel = "SIMPLE_RADIAL"
    focal: float | None = None
    intrinsics: Path | None = None
    camera: CameraMotion = "moving"
    masks: str = "motion"
    depth: str | None = None
    holdout: int = 0
    weights: Path | None = None

    @property
    def depth_method(self) -> str:
        """The name in ``depth.DEPTHS``."""
        return self.depth or ("flow" if self.camera == "moving" else "none")
