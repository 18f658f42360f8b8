"""Deliberate damage to masks."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MaskPerturbation:
    """Deliberate damage to the training masks (paper, robustness); evaluation always uses the true masks.

    Attributes:
        erode: Erode the dynamic region by this many pixels.
        dilate: Dilate the dynamic region by this many pixels.
        holes: Fraction of the dynamic region to remove as random holes, in [0, 1).
    """

    erode: int = 0
    dilate: int = 0
    holes: float = 0.0

    @staticmethod
    def parse(text: str | None) -> "MaskPerturbation":
        """What the option ``damage_masks`` says, such as ``erode:4`` or ``dilate:2,holes:0.2``; nothing if None.

        Raises:
            ValueError: If it says something else.
        """
        types = {"erode": int, "dilate": int, "holes": float}
        try:
            parts = dict(part.split(":") for part in text.split(",")) if text is not None else {}
            return MaskPerturbation(**{name: types[name](value) for name, value in parts.items()})
        except (KeyError, ValueError):
            raise ValueError(
                f"damage_masks must be erode:PIXELS, dilate:PIXELS or holes:FRACTION, got {text!r}"
            ) from None
