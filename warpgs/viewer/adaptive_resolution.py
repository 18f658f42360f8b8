"""Resolution of the images: low while something changes, then step by step the full one at rest."""

from typing import NamedTuple

SCALES = tuple(2.0 ** (-k / 2) for k in range(7))
"""Scales of the image sides to choose from, from 1 down to 1/8."""

TARGET_SECONDS = 1 / 12
"""Time that an image may take while something changes [s]."""

DECAY = 0.8
"""Weight of all earlier measurements relative to a new one."""

MAX_OVERHEAD = 1.5
"""An image may also take this multiple of the fixed cost: below that, a lower resolution saves little time."""


class _Sums(NamedTuple):
    """Decaying sums for a linear regression of seconds (y) on megapixels (x)."""

    n: float = 0.0
    x: float = 0.0
    y: float = 0.0
    xx: float = 0.0
    xy: float = 0.0


class AdaptiveResolution:
    """Estimates the cost of images, a fixed part and a part per pixel, and chooses resolutions accordingly."""

    def __init__(self, target_seconds: float = TARGET_SECONDS) -> None:
        self._target_seconds = target_seconds
        self._sums = _Sums()

    def add(self, pixels: int, seconds: float) -> None:
        """Adds the measurement of an image."""
        x = pixels * 1e-6
        new = (1.0, x, seconds, x * x, x * seconds)
        self._sums = _Sums(*(DECAY * old + value for old, value in zip(self._sums, new, strict=True)))

    def cost(self) -> tuple[float, float]:
        """Estimated cost of an image: the fixed part [s], and the part per million pixels [s]; neither is negative."""
        n, x, y, xx, xy = self._sums
        if n == 0:
            return 0.0, 0.0
        variance = xx - x * x / n
        slope = (xy - x * y / n) / variance if variance > 1e-3 * xx else y / max(x, 1e-9)
        slope = min(max(slope, 0.0), y / max(x, 1e-9))
        return (y - slope * x) / n, slope

    def interactive_scale(self, pixels: int) -> float:
        """The scale to render at while something changes, for an image with ``pixels`` at full resolution."""
        fixed, slope = self.cost()
        allowed = max(self._target_seconds, MAX_OVERHEAD * fixed)
        fits = [scale for scale in SCALES if fixed + slope * pixels * scale**2 * 1e-6 <= allowed]
        return fits[0] if fits else SCALES[-1]

    @staticmethod
    def refined(scale: float) -> float:
        """The next scale at rest: four times the pixels, so that all steps before the last cost a third of the last."""
        return min(1.0, 2.0 * scale)
