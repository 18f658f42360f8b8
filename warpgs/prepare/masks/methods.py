"""The methods that find what moves."""

from pathlib import Path

from ..cameras.posed_frames import PosedFrames
from ..weights import SAM2
from .masker import DynamicMasks, Masker
from .motion import find_dynamic
from .still import find_before_background


def find_moving(frames: PosedFrames, quiet: bool) -> DynamicMasks:
    """What moves, as motion shows it, and the background if the camera stands still."""
    return (find_before_background if frames.stand_still else find_dynamic)(frames, quiet)


def _sam2(frames: PosedFrames, weights: Path | None, quiet: bool) -> DynamicMasks:
    from .sam2 import track  # imports torch

    assert weights is not None
    return track(frames.images, find_moving(frames, quiet), weights, quiet)


MASKERS: dict[str, Masker | None] = {
    "motion": Masker(lambda frames, weights, quiet: find_moving(frames, quiet)),
    "sam2": Masker(_sam2, SAM2),
    "none": None,
}
"""Values of ``--masks`` apart from a folder. A new method is a new file and a line here."""
