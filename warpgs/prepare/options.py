"""What to make of a source."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from .frames import Selection

LensModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
"""COLMAP's models of a lens that a capture's cameras can hold."""


@dataclass(frozen=True)
class Options:
    """What to make of a source.

    Attributes:
        source: Video, or folder of pictures.
        selection: Frames to take.
        lens: COLMAP's model of the lens.
        masks: "motion", "none", or a folder of masks, 0 = moving.
        depth: "flow" or "none".
        holdout: Every so many-th frame is for evaluation; 0 for none.
    """

    source: Path
    selection: Selection = field(default_factory=Selection)
    lens: LensModel = "SIMPLE_RADIAL"
    masks: str = "motion"
    depth: Literal["flow", "none"] = "flow"
    holdout: int = 0

    def check(self) -> None:
        """Raises ``ValueError`` for options that can't be."""
        self.selection.check()
        if self.holdout < 0 or self.holdout == 1:
            raise ValueError(f"--holdout must be 0 (none) or at least 2, got {self.holdout}")
        if self.masks not in ("motion", "none") and not Path(self.masks).is_dir():
            raise ValueError(f"--masks must be motion, none or a folder of masks; {self.masks} is no folder")
