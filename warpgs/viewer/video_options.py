"""How long, how fast and how large the video of a camera path is."""

from typing import NamedTuple

DURATIONS, RATES, SIDES = (0.1, 600.0), (1.0, 120.0), (16, 4096)
"""Ranges of the duration [s], the frames per second and the sides of the image [px]."""


class VideoOptions(NamedTuple):
    """The video of a camera path.

    Attributes:
        duration: Duration [s].
        rate: Frames per second.
        size: (width, height) [px], even: codecs need that.
    """

    duration: float = 5.0
    rate: float = 24.0
    size: tuple[int, int] = (1280, 720)

    @property
    def frames(self) -> int:
        """Number of frames, at least one."""
        return max(1, round(self.duration * self.rate))

    @staticmethod
    def of(duration: object, rate: object, size: object) -> "VideoOptions":
        """Options that are within their ranges, whatever a browser sends."""
        width, height = size if isinstance(size, tuple | list) and len(size) == 2 else VideoOptions().size
        sides = (int(_within(side, SIDES, 2.0 * SIDES[0])) & ~1 for side in (width, height))
        return VideoOptions(_within(duration, DURATIONS, 5.0), _within(rate, RATES, 24.0), tuple(sides))  # type: ignore[arg-type]


def _within(value: object, bounds: tuple[float, float], otherwise: float) -> float:
    """A number within bounds; ``otherwise`` for what is not a number."""
    if not isinstance(value, int | float) or value != value:
        return otherwise
    return float(min(max(value, bounds[0]), bounds[1]))
