"""Playback of the scene's time."""

CLIP_SECONDS = 5.0
"""Duration of the scene at speed 1 [s]."""


class Clock:
    """Advances the scene's time in a loop from 0 to 1 while it plays."""

    def __init__(self) -> None:
        self.playing = False
        self._before: float | None = None

    def toggle(self) -> None:
        self.playing = not self.playing
        self._before = None

    def advance(self, time: float, speed: float, now: float) -> float:
        """The time in [0, 1] to show at wall-clock time ``now`` [s], after ``time`` was shown at the last call."""
        before, self._before = self._before, now
        if not self.playing or before is None:
            return time
        return (time + speed * (now - before) / CLIP_SECONDS) % 1.0
