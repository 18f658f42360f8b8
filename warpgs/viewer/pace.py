"""How many pixels to draw: few while something moves, step by step all of them at rest."""

from typing import NamedTuple

SCALES = tuple(2.0 ** (-k / 2) for k in range(7))
"""Sides of the image to choose from, as shares of the whole: from 1 down to an eighth."""

MOVING_SECONDS = 1 / 12
"""Time that an image may take while something moves."""

FORGET = 0.8
"""Weight of everything measured so far against the newest image."""

MAX_FIXED = 1.5
"""What an image may take while moving, as a multiple of the part that pixels do not change: less would only blur it."""


class _Sums(NamedTuple):
    """Decaying sums for a straight line through (pixels, seconds)."""

    n: float = 0.0
    x: float = 0.0
    y: float = 0.0
    xx: float = 0.0
    xy: float = 0.0


class Pace:
    """Learns what images cost, a fixed part and a part for each pixel, and chooses sizes by that."""

    def __init__(self, moving_seconds: float = MOVING_SECONDS) -> None:
        self._moving_seconds = moving_seconds
        self._sums = _Sums()

    def took(self, pixels: int, seconds: float) -> None:
        """Learns from an image that was drawn."""
        x = pixels * 1e-6
        new = (1.0, x, seconds, x * x, x * seconds)
        self._sums = _Sums(*(FORGET * old + value for old, value in zip(self._sums, new, strict=True)))

    def cost(self) -> tuple[float, float]:
        """Seconds of an image: the fixed part, and per million pixels. Neither is negative."""
        n, x, y, xx, xy = self._sums
        if n == 0:
            return 0.0, 0.0
        spread = xx - x * x / n
        slope = (xy - x * y / n) / spread if spread > 1e-3 * xx else y / max(x, 1e-9)
        slope = min(max(slope, 0.0), y / max(x, 1e-9))
        return (y - slope * x) / n, slope

    def while_moving(self, pixels: int) -> float:
        """The scale to draw at while something moves, for an image that has ``pixels`` as a whole."""
        fixed, slope = self.cost()
        allowed = max(self._moving_seconds, MAX_FIXED * fixed)
        fits = [scale for scale in SCALES if fixed + slope * pixels * scale**2 * 1e-6 <= allowed]
        return fits[0] if fits else SCALES[-1]

    @staticmethod
    def refined(scale: float) -> float:
        """The next scale at rest: four times the pixels, so that the steps before the last cost a third of it."""
        return min(1.0, 2.0 * scale)
