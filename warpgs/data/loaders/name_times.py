"""Times of frames from their file names: time stamps, else numbers, else the sorted order of the names."""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from warpgs.data.time_source import TimeSource, with_steps
from warpgs.errors import visible

from .name_stamps import SECOND, find_stamps
from .rigs import follows_camera, share_times

SUFFIX = re.compile(r"(?i)\.(png|jpe?g|heic|heif|webp|tiff?|bmp|exr|dng)$")

MAX_NAME = 4096
"""Number of characters of a path that are looked at; no file has a longer one."""

NUMBER = re.compile(r"([0-9]{1,40})")

MAX_GAP, MAX_STEPS, MIN_TIMES = 0.9, 10.0, 4
"""Numbers do not tell times if one of their steps is more than this part of the whole and this many times their median
step; of fewer times, nothing is said."""

ROLLOVER = 10_000
"""Counters of cameras have four digits, by the Design rule for Camera File systems, and begin again after 9999; Sony
writes a zero before them."""

REMEDY = "number the images in the order of time if that is wrong"


class NamedTimes(NamedTuple):
    """Times of names.

    Attributes:
        times: Of each name, from the first frame on.
        source: Where they come from.
        are_read: Whether the names hold them; if not, they count the names.
        cameras: Number of the camera of each name, in the order of the names; all 0 if the names tell none.
    """

    times: list[float]
    source: TimeSource
    are_read: bool
    cameras: list[int]


class _Reading(NamedTuple):
    """A number of every name that may be its time, and the rest of the name, before and after it.

    If it is a time of day, ``midnight`` is the first one of the next day, if there is any.
    """

    values: list[int]
    rests: list[tuple[str, str]]
    is_stamp: bool = False
    midnight: int | None = None


def times_of_names(paths: Sequence[str]) -> NamedTimes:
    """Time of each frame from its name.

    The most specific number that differs between the frames of a camera is its time: time stamps, else counters.
    Cameras of one rig may have frames of the same times. Where no number can be the time, or nearly all of the time
    would be between two frames, the names are counted in their order.

    Args:
        paths: Names of the images in sorted order, with or without folders and suffixes.
    """
    if not paths:
        return NamedTimes([], TimeSource("no times"), False, [])
    stems = [_stem(path) for path in paths]
    stamps = (_Reading(found.nanoseconds, found.rests, True, found.midnight) for found in find_stamps(stems))
    numbers = [*_numbers(stems)]
    for reading in (*stamps, *numbers):
        if _tells_times(reading):
            return _times(paths, reading)
    return _counted(paths, _missing_numbers(paths, stems, numbers))


def _stem(path: str) -> str:
    stem = path[-MAX_NAME:].replace("\\", "/")
    return SUFFIX.sub("", SUFFIX.sub("", stem))  # IMG_0001.HEIC.jpg has two


def _numbers(stems: Sequence[str]) -> Iterator[_Reading]:
    """Numbers of the names that may count frames, the last ones first: they differ, and do not count cameras."""
    parts = [NUMBER.split(stem) for stem in stems]  # text and numbers alternate
    last = min(map(len, parts)) - 2
    if last < 0:
        return
    columns = [last] if len({*map(len, parts)}) == 1 else [-2]
    if columns == [last]:
        differing = [k for k in range(1, last + 1, 2) if len({part[k] for part in parts}) > 1]
        of_frames = [k for k in differing if not all(follows_camera("".join(part[:k])) for part in parts)]
        columns = of_frames[::-1] or columns
    for k in columns:
        rests = [("".join(part[:k]), "".join(part[k:][1:])) for part in parts]
        yield _Reading([int(part[k]) for part in parts], rests)


def _tells_times(reading: _Reading) -> bool:
    """Whether no two frames of a camera have the same number, and numbers follow the order of the names."""
    values, rests, is_stamp, _ = reading
    if len({*zip(values, rests, strict=True)}) < len(values):
        return False
    if len({*values}) == len(values):
        other_numbers = {tuple(NUMBER.findall("#".join(rest))) for rest in rests}
        if is_stamp or len(other_numbers) == 1 or all(a < b for a, b in pairwise(values)):
            return True
    return share_times(values, ["#".join(rest) for rest in rests])


def _times(paths: Sequence[str], reading: _Reading) -> NamedTimes:
    """Times of numbers, unless one of their steps is far too large; gaps between time stamps stay."""
    values, problem = reading.values, ""
    if (jump := _jump(values)) is not None:
        before, after = (paths[values.index(value)] for value in jump)
        values, problem = _after_jump(values, jump, before, reading.is_stamp)
        if _jump(values) is not None and not reading.is_stamp:
            return _counted(paths, f"the numbers in them jump from {_shown(before)} to {_shown(after)}")
        problem = problem.format(_shown(before), _shown(after))
    if reading.midnight is not None:
        last = max(value for value in values if value < reading.midnight)
        before, after = (_shown(paths[values.index(value)]) for value in (last, reading.midnight))
        problem = f"they are taken to go on after midnight, from {before} to {after}"
    first, divisor = min(values), SECOND if reading.is_stamp else 1
    times = [(value - first) / divisor for value in values]
    kind, unit = ("time stamps", " s") if reading.is_stamp else ("numbers", "")
    text = with_steps(f"times from the {kind} in the names", times, unit)
    shared = ", which cameras share" if len({*values}) < len(values) else ""
    return NamedTimes(times, TimeSource(text + shared, problem), True, _cameras(reading))


def _cameras(reading: _Reading) -> list[int]:
    """The camera of each name by what is left of it without the number, if these are of one rig."""
    rests = ["#".join(rest) for rest in reading.rests]
    if not share_times(reading.values, rests):
        return [0] * len(rests)
    number = {rest: k for k, rest in enumerate(dict.fromkeys(rests))}
    return [number[rest] for rest in rests]


def _after_jump(values: list[int], jump: tuple[int, int], before: str, is_stamp: bool) -> tuple[list[int], str]:
    """Values with a jump, mended if a camera's counter began again, and the problem with them, as a format.

    Args:
        values: Of all frames.
        jump: Those before and after it.
        before: Name of the frame before it.
        is_stamp: Whether they are time stamps.
    """
    if is_stamp:
        return values, "nearly all of the time is from {} to {}: remove frames of another recording"
    is_padded = re.search(rf"(?<![0-9])0?{jump[0]:04d}(?![0-9])", before) is not None
    if is_padded and jump[0] < ROLLOVER // 100 and ROLLOVER - ROLLOVER // 100 <= max(values) < ROLLOVER:
        problem = f"they are taken to begin again after {ROLLOVER - 1}, as there are none between {{}} and {{}}"
        return [value + ROLLOVER * (value <= jump[0]) for value in values], problem
    return values, ""


def _jump(values: Sequence[int]) -> tuple[int, int] | None:
    """The numbers before and after a step that is nearly all of the whole; None if there is none."""
    distinct = sorted({*values})
    if len(distinct) < MIN_TIMES:
        return None
    steps = [b - a for a, b in pairwise(distinct)]
    k = steps.index(max(steps))
    is_jump = steps[k] > max(MAX_GAP * sum(steps), MAX_STEPS * float(np.median(steps)))
    return (distinct[k], distinct[k + 1]) if is_jump else None


def _counted(paths: Sequence[str], reason: str) -> NamedTimes:
    """Times that count the names in their order, and why."""
    times = [float(k) for k in range(len(paths))]
    text = f"times from the sorted order of the names, because {reason}"
    return NamedTimes(times, TimeSource(text, REMEDY if len(paths) > 1 else ""), False, [0] * len(times))


def _missing_numbers(paths: Sequence[str], stems: Sequence[str], numbers: Sequence[_Reading]) -> str:
    """Why no number is a time."""
    without = next((path for path, stem in zip(paths, stems, strict=True) if not NUMBER.search(stem)), None)
    if without is not None or not numbers:
        return f"{_shown(without or paths[0])} has no number"
    values = numbers[0].values
    for k, (a, b) in enumerate(pairwise(values)):
        if b <= a:
            return f"the numbers in them do not grow from {_shown(paths[k])} to {_shown(paths[k + 1])}"
    return "the numbers in them do not count frames"


def _shown(path: str) -> str:
    return visible(path)[-60:]
