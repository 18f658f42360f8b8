"""Options that ``load_with`` passes on to every loader."""

from dataclasses import dataclass, field

from warpgs.config import MaskPerturbation
from warpgs.data.capture import Side


@dataclass(frozen=True)
class LoadOptions:
    """How a capture is read; ``load_with`` has checked them.

    Attributes:
        factor, perturbation, cache_frames, distortion, readout: Arguments of ``load_capture``.
        readout_from: See ``Capture.readout_from``; that of the capture's files if None.
        depth: Whether to read depth. Without it the capture is the same as one whose files have none: it has no points
            that are unprojected from depth either.
    """

    factor: int | None = None
    perturbation: MaskPerturbation = field(default_factory=MaskPerturbation)
    cache_frames: int = 256
    distortion: bool = True
    depth: bool = True
    readout: float | None = None
    readout_from: Side | None = None
