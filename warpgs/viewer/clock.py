"""The time that is shown, and how it runs."""

CLIP_SECONDS = 5.0
"""What speed 1 takes from the first moment to the last."""


class Clock:
    """Runs time from 0 to 1 over and over while it plays."""

    def __init__(self) -> None:
        self.playing = False
        self._before: float | None = None

    def toggle(self) -> None:
        self.playing = not self.playing
        self._before = None

    def advance(self, moment: float, speed: float, now: float) -> float:
        """The moment to show at the clock's ``now`` [s], after ``moment`` was shown the time before."""
        before, self._before = self._before, now
        if not self.playing or before is None:
            return moment
        return (moment + speed * (now - before) / CLIP_SECONDS) % 1.0
