"""What to make of a source."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from .frames import Selection
from .networks import DEPTH_ANYTHING, SAM2, find_weights

LensModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
"""COLMAP's models of a lens that a capture's cameras can hold."""


@dataclass(frozen=True)
class Options:
    """What to make of a source.

    Attributes:
        source: Video, or folder of pictures.
        selection: Frames to take.
        lens: COLMAP's model of the lens.
        masks: "motion", "sam2", "none", or a folder of masks, 0 = moving.
        depth: "flow", "anything" or "none".
        holdout: Every so many-th frame is for evaluation; 0 for none.
        weights: Folder of the weights of networks that are asked for; None for the Hugging Face cache.
    """

    source: Path
    selection: Selection = field(default_factory=Selection)
    lens: LensModel = "SIMPLE_RADIAL"
    masks: str = "motion"
    depth: Literal["flow", "anything", "none"] = "flow"
    holdout: int = 0
    weights: Path | None = None

    @property
    def finds_motion(self) -> bool:
        """Whether masks begin with the motion in the pictures."""
        return self.masks in ("motion", "sam2")

    @property
    def inputs(self) -> dict[str, Path]:
        """All that is read, by what it is."""
        masks = {} if self.finds_motion or self.masks == "none" else {"masks": Path(self.masks)}
        return {"source": self.source, **masks, **({"weights": self.weights} if self.weights else {})}

    def check(self) -> None:
        """Refuses options that can't be.

        Raises:
            ValueError: If a value is out of range, or a folder or the weights of a network are missing.
            ImportError: If the package of the networks is missing.
        """
        self.selection.check()
        if self.holdout < 0 or self.holdout == 1:
            raise ValueError(f"--holdout must be 0 (none) or at least 2, got {self.holdout}")
        if not self.finds_motion and self.masks != "none" and not Path(self.masks).is_dir():
            raise ValueError(f"--masks must be motion, sam2, none or a folder of masks; {self.masks} is no folder")
        networks = [SAM2] * (self.masks == "sam2") + [DEPTH_ANYTHING] * (self.depth == "anything")
        if self.weights is not None and not networks:
            raise ValueError("--weights is for --masks sam2 and --depth anything: neither was asked for")
        for network in networks:
            find_weights(network, self.weights)
