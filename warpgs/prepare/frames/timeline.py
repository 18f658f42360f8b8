"""Which frames of a video are taken together: from their times, before any frame is decoded."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from ..options import MAX_FRAMES, Selection

DEFAULT_FRAMES = 150
"""Number of frames taken from a video if neither a rate nor a number is given."""


@dataclass(frozen=True)
class Timeline:
    """The selected part of a video, cut into intervals, of each of which one frame is taken.

    Attributes:
        steps: Index in the video of each selected frame, by its time [s from the first frame].
        intervals: Number of the interval of each selected frame, by its time; it never decreases.
    """

    steps: dict[Fraction, int]
    intervals: dict[Fraction, int]


def plan_timeline(source: str, times: Sequence[Fraction], selection: Selection) -> Timeline:
    """Cuts a video into intervals of equal duration.

    Args:
        source: Name of the video, for messages.
        times: Times of all frames, ascending [s from the first frame].
        selection: Rate or number of frames, and the part of the video.

    Raises:
        ValueError: If no frame is in the selected part, or more than ``MAX_FRAMES`` would be taken.
    """
    start, end = selection.start, selection.end
    steps = {t: k for k, t in enumerate(times) if start <= float(t) and (end is None or float(t) <= end)}
    if not steps:
        raise ValueError(f"{source} ends after {float(times[-1]):.1f} s: no frame is in the part from --start to --end")
    chosen = [*steps]
    count, first = len(chosen), chosen[0]
    duration = (chosen[-1] - first) * Fraction(count, max(count - 1, 1))  # the last frame lasts as long as the others
    wanted = selection.count or DEFAULT_FRAMES if selection.fps is None else float(duration) * selection.fps
    if wanted >= count or duration == 0:
        intervals = {t: k for k, t in enumerate(chosen)}
    else:
        length = duration / wanted if selection.fps is None else 1 / Fraction(selection.fps)
        intervals = {t: int((t - first) / length) for t in chosen}
    if (taken := len(set(intervals.values()))) > MAX_FRAMES:
        raise ValueError(
            f"{source} gives {taken} frames, the maximum is {MAX_FRAMES}: take a part of it (--start, --end) or fewer "
            "frames (--fps, --count)"
        )
    return Timeline(steps, intervals)
