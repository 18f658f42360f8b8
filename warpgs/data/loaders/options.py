"""Options that ``load_with`` passes on to every loader."""

from dataclasses import dataclass, field, replace

from warpgs.config import MaskPerturbation
from warpgs.data.lens import Lens
from warpgs.data.taken import without_distortion


@dataclass(frozen=True)
class LoadOptions:
    """How a capture is read; ``load_with`` has checked them.

    Attributes:
        factor, perturbation, cache_frames, undistort: Arguments of ``load_capture``.
        depth: Whether to read depth. Without it the capture is the same as one whose files have none: it has no points
            that are unprojected from depth either.
    """

    factor: int | None = None
    perturbation: MaskPerturbation = field(default_factory=MaskPerturbation)
    cache_frames: int = 256
    undistort: bool = True
    depth: bool = True

    def lens(self, lens: Lens) -> Lens:
        """The lens that a frame is undistorted for: its own, or one without distortion and with a centred image."""
        if self.undistort:
            return lens
        return replace(without_distortion(lens), center=(lens.width / 2, lens.height / 2))
