"""The common clock of several videos of one event: when each was started, and the time that all of them show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from warpgs.command_line.progress import progress
from warpgs.errors import counted
from warpgs.files import require_file

from ..options import MIN_FRAMES, Selection
from .sound import Match, compare, read_onsets
from .video import MAX_BYTES, time_stamps

MAX_CONTRADICTION = 0.05
"""Difference of two offsets that must be equal, from which on the sounds contradict each other [s]."""

EPSILON = 1e-6
"""What rounding may add to a time [s]."""

GIVE = "give the time at which each video starts with --offset, such as --offset 0,0.37,1.2 [s]"


@dataclass(frozen=True)
class Clock:
    """When several videos were recorded, on one clock that starts with the first of them.

    Attributes:
        starts: Time of the first frame of each [s].
        begin, end: The time that all of them show [s].
    """

    starts: list[float]
    begin: float
    end: float

    def selection(self, video: int, selection: Selection) -> Selection:
        """The part of a video that is selected of the time that all of them show, on the video's own clock.

        Raises:
            ValueError: If it is empty.
        """
        length = self.end - self.begin
        if selection.start >= length:
            raise ValueError(f"the videos show {length:.1f} s together: no frame is in the part from --start on")
        own = self.begin - self.starts[video]
        last = length if selection.end is None else min(selection.end, length)
        return replace(selection, start=max(own + selection.start - EPSILON, 0.0), end=own + last + EPSILON)


def common_clock(
    sources: Sequence[Path], offsets: Sequence[float] | None, quiet: bool = True, needed: int = MIN_FRAMES
) -> tuple[Clock, str]:
    """The clock of several videos, and a note that says where it comes from.

    Args:
        sources: The videos.
        offsets: When each of them starts, from any common moment on [s]; None to find it from their sound.
        quiet: Whether to show no progress.
        needed: Number of frames that each must have in the time that all of them show.

    Raises:
        ValueError: If one is not a video, sound does not tell when it starts, or they have too little time in common.
    """
    for source in sources:
        require_file(source, MAX_BYTES)
    stamps = [time_stamps(source)[0] for source in progress(sources, "times", quiet)]
    found = find_offsets(sources, [s[0] for s in stamps], quiet) if offsets is None else list(offsets)
    starts = [start - min(found) for start in found]
    ends = [start + float(s[-1] - s[0]) for start, s in zip(starts, stamps, strict=True)]
    clock = Clock(starts, max(starts), min(ends))
    _require_together(sources, clock, [[float(t - own[0]) for t in own] for own in stamps], needed)
    where = "from their sound" if offsets is None else "as given"
    listed = ", ".join(f"{name} {start:.3f} s" for name, start in zip(short_names(sources), starts, strict=True))
    return clock, f"the videos start at {listed}, {where}"


def short_names(sources: Sequence[Path]) -> list[str]:
    """What messages call videos: their files' names, or their paths where several files have one name."""
    names = [source.name for source in sources]
    return [name if names.count(name) == 1 else str(source) for name, source in zip(names, sources, strict=True)]


def _require_together(sources: Sequence[Path], clock: Clock, times: Sequence[Sequence[float]], needed: int) -> None:
    """Raises ValueError if a video has too few frames in the time that all show; names those that limit this time.

    Args:
        sources: The videos.
        clock: Their clock.
        times: Times of the frames of each, from its first on [s].
        needed: Number of frames that each must have.
    """
    ends = [start + own[-1] for start, own in zip(clock.starts, times, strict=True)]
    a, b = ends.index(clock.end), clock.starts.index(clock.begin)
    if clock.end < clock.begin:
        raise ValueError(
            f"{sources[b]} starts {clock.begin - clock.starts[a]:.2f} s after {sources[a]}, which takes only "
            f"{times[a][-1]:.2f} s: they have no time in common"
        )
    counts = [
        sum(clock.begin - EPSILON <= start + time <= clock.end + EPSILON for time in own)
        for start, own in zip(clock.starts, times, strict=True)
    ]
    if (count := min(counts)) < needed:
        seconds, limits = clock.end - clock.begin, f"from the start of {sources[b]} to the end of {sources[a]}"
        limits = f"the length of {sources[a]}" if seconds > times[a][-1] - EPSILON else limits
        raise ValueError(
            f"the videos show only {seconds:.2f} s together, {limits}: {counted(count, 'frame')} of "
            f"{sources[counts.index(count)]}, at least {needed} are needed; leave out what is too short or damaged"
        )


def find_offsets(sources: Sequence[Path], first_frames: Sequence[Fraction], quiet: bool = True) -> list[float]:
    """When each video starts after the first one [s], from their sound.

    Each is compared with all others, and placed by the one that it resembles most.

    Raises:
        ValueError: If one has no sound or a damaged one, resembles none of the others, or they contradict each other.
    """
    onsets = []
    for source, first in zip(progress(sources, "sound", quiet), first_frames, strict=True):
        try:
            found = read_onsets(source, first)
        except ValueError as error:
            raise ValueError(f"{error}; {GIVE}") from error
        if found is None:
            raise ValueError(f"{source} has no sound, which tells when it starts: {GIVE}")
        onsets.append(found)
    matches = compare(onsets)
    starts = _placed(matches, len(sources))
    if len(starts) == 1:
        raise ValueError(f"the sounds of {' and '.join(map(str, sources))} do not tell when they start: {GIVE}")
    if lost := [source for k, source in enumerate(sources) if k not in starts]:
        names = short_names(sources)
        found_so_far = ", ".join(f"{names[k]} {start:.2f} s" for k, start in sorted(starts.items()))
        raise ValueError(
            f"the sound of {lost[0]} does not tell when it starts (found: {found_so_far}): {GIVE}, or leave it out"
        )
    for (a, b), match in matches.items():
        if match.is_certain and abs(starts[b] - starts[a] - match.offset) > MAX_CONTRADICTION:
            raise ValueError(
                f"the sounds contradict each other: {sources[b]} starts {match.offset:.2f} s after {sources[a]}, but "
                f"{starts[b] - starts[a]:.2f} s as other videos say; {GIVE}"
            )
    return [starts[k] for k in range(len(sources))]


def _placed(matches: dict[tuple[int, int], Match], count: int) -> dict[int, float]:
    """When each recording starts after the first one, for the most recordings that certain matches connect."""
    return max((_placed_with(first, matches, count) for first in range(count)), key=len)


def _placed_with(first: int, matches: dict[tuple[int, int], Match], count: int) -> dict[int, float]:
    """When each recording that certain matches connect with one starts after that one.

    Prim's algorithm: the most certain match from a placed recording to another one places the latter.
    """
    starts = {first: 0.0}
    while len(starts) < count:
        reaching = {
            pair: match for pair, match in matches.items() if match.is_certain and len(starts.keys() & {*pair}) == 1
        }
        if not reaching:
            break
        (a, b), match = max(reaching.items(), key=lambda item: item[1].ratio)
        if a in starts:
            starts[b] = starts[a] + match.offset
        else:
            starts[a] = starts[b] - match.offset
    return starts


def check_offsets(offsets: Sequence[float] | None, count: int) -> None:
    """Checks that there is an offset for each of some videos.

    Raises:
        ValueError: If there are too many or too few, or one is not finite.
    """
    if offsets is None:
        return
    if count == 1:
        raise ValueError("--offset is for several videos")
    if len(offsets) != count or not all(map(math.isfinite, offsets)):
        given = ",".join(f"{offset:g}" for offset in offsets)
        raise ValueError(f"--offset must be a time for each of the {count} videos, separated by commas, got {given}")
