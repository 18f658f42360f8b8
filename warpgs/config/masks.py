"""The options ``--masks.*``."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MaskPerturbation:
    """Deliberate damage to the training masks (paper, robustness); evaluation always uses the true masks."""

    erode: int = 0
    """Erode the dynamic region by this many pixels."""
    dilate: int = 0
    """Dilate the dynamic region by this many pixels."""
    holes: float = 0.0
    """Fraction of the dynamic region to remove as random holes, in [0, 1)."""
