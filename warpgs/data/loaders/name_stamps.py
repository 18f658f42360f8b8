"""Time stamps in file names: dates with the time of day, seconds since 1970, seconds and nanoseconds.

Cameras and phones write dates (IMG_20240131_142233, PXL_20240131_142233123, 2024-01-31 14.22.33), TUM's tools decimal
seconds (1305031102.4, trailing zeros may be omitted), programs that read ROS bags nanoseconds (1403636579763555584) or
seconds and nanoseconds, with zeros before the latter or without (1305031102_400000000, 1305031102_5000000).
"""

import re
import statistics
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from typing import NamedTuple

SECOND = 10**9
"""Nanoseconds."""

EARLIEST = 10**9
"""Seconds of a calendar or since 1970 are more; smaller ones may be any number."""

SHORTEST_COUNTED, MIN_COUNTED = SECOND // 10, 6
"""Fractions of seconds count frames if all are shorter than this [ns], or if this many never begin again."""

TIME_OF_DAY = (
    r"(?P<clock>[0-9]{2}[-_.:h]?[0-9]{2}[-_.:m]?[0-9]{2})s?"
    r"(?:(?P<mark>[._,-]?)(?P<part>[0-9]{9}|[0-9]{6}|[0-9]{3}|(?<=\.)[0-9]{1,9}))?(?![0-9])"
)
DAY = r"(?P<date>[12][0-9]{3}[-_.]?[0-9]{2}[-_.]?[0-9]{2})(?:[ _T.-]|[ _]at[ _])?"
DATE, CLOCK = re.compile(rf"(?<![0-9]){DAY}{TIME_OF_DAY}"), re.compile(rf"(?<![0-9]){TIME_OF_DAY}")

EPOCH = re.compile(r"(?<![0-9])(?P<seconds>[1-4][0-9]{9})(?:(?P<mark>[._-]?)(?P<part>[0-9]{1,9}))?(?![0-9])")
"""Seconds since 1970, from 2001 on; what follows may be a fraction of a second or a number."""

PAIR = re.compile(r"(?<![0-9])(?P<seconds>[0-9]{1,10})(?P<mark>[._-])(?P<part>[0-9]{9})(?![0-9])")
"""Seconds since any time, and nanoseconds."""

DECIMAL = re.compile(r"(?<![0-9])(?P<seconds>[0-9]{1,10})(?P<mark>\.)(?P<part>[0-9]{1,9})(?![0-9])")

AFTER_LETTERS = re.compile(r"(?i)(?<![a-z])(t|ts|sec|time|stamp|timestamp)$")
"""Words that a decimal number may follow directly: shot1.0001 is a shot and a frame."""


DAY_LENGTH = 86_400 * SECOND
"""Nanoseconds."""

MIN_TIMES, MAX_STEPS = 4, 10.0
"""Times of day go on after midnight if there are this many, if most of the day is between two of them, and if those
are at most this many times the median step apart when they go on."""


class Stamps(NamedTuple):
    """A time stamp of every name.

    Attributes:
        nanoseconds: Since any time.
        rests: The rest of each name, before and after it.
        midnight: The first time of the next day, if times of day go on after midnight.
    """

    nanoseconds: list[int]
    rests: list[tuple[str, str]]
    midnight: int | None = None


def find_stamps(stems: Sequence[str]) -> Iterator[Stamps]:
    """Ways to read time stamps that differ between the names, the most specific first.

    Args:
        stems: Names without suffixes.
    """
    readers = {DATE: _date, EPOCH: _seconds, PAIR: _seconds, DECIMAL: _decimal, CLOCK: _date}
    for pattern, seconds_of in readers.items():
        matches = [[*pattern.finditer(stem)] for stem in stems]
        counts = {len(found) for found in matches}
        if len(counts) != 1:
            continue
        for k in reversed(range(counts.pop())):  # the last one that differs belongs to the frame
            chosen = [found[k] for found in matches]
            stamps = _stamps(chosen, seconds_of)
            if stamps is None or len(set(stamps.nanoseconds)) == 1:
                continue
            stamps = _past_midnight(stamps) if pattern is CLOCK else stamps
            if pattern is not CLOCK or _is_clock([match["clock"] for match in chosen], stamps.nanoseconds):
                yield stamps


def _stamps(matches: Sequence[re.Match[str]], seconds_of: Callable[[re.Match[str]], int | None]) -> Stamps | None:
    """The time stamps of one match in every name; None if they are none."""
    seconds = [second for match in matches if (second := seconds_of(match)) is not None]
    if len(seconds) < len(matches):
        return None
    parts = [match["part"] or "" for match in matches]
    marks = {match["mark"] for match in matches if match["part"]}
    fractions = _fractions(parts, marks)
    is_given = min(seconds) >= EARLIEST and marks <= {".", ""}
    if fractions is not None and any(parts) and not is_given and _are_counted(seconds, fractions):
        fractions = None
    if fractions is None and ("" in marks or min(seconds) < EARLIEST):
        return None  # digits of a longer number, or two numbers
    ends = [match.start("part") if fractions is None and match["part"] else match.end() for match in matches]
    values = [SECOND * whole + part for whole, part in zip(seconds, fractions or [0] * len(parts), strict=True)]
    rests = [(match.string[: match.start()], match.string[end:]) for match, end in zip(matches, ends, strict=True)]
    return Stamps(values, rests)


def _past_midnight(stamps: Stamps) -> Stamps:
    """Times of day that go on after midnight, if nearly all of the day is missing otherwise."""
    times = sorted({*stamps.nanoseconds})
    if len(times) < MIN_TIMES:
        return stamps
    steps = [b - a for a, b in pairwise(times)]
    k = steps.index(max(steps))
    over_midnight = times[0] + DAY_LENGTH - times[-1]
    if steps[k] <= DAY_LENGTH // 2 or over_midnight > MAX_STEPS * statistics.median(steps[:k] + steps[k + 1 :]):
        return stamps
    nanoseconds = [time + DAY_LENGTH * (time <= times[k]) for time in stamps.nanoseconds]
    return Stamps(nanoseconds, stamps.rests, times[0] + DAY_LENGTH)


def _are_counted(seconds: Sequence[int], fractions: Sequence[int]) -> bool:
    """Whether fractions of seconds count frames instead: from 0 on in every second, or on through all seconds."""
    in_order = [fraction for _, fraction in sorted(zip(seconds, fractions, strict=True))]
    goes_on = len({*seconds}) > 1 and all(a < b for a, b in pairwise(in_order))
    return max(fractions) < SHORTEST_COUNTED or (goes_on and len(fractions) >= MIN_COUNTED)


def _fractions(parts: Sequence[str], marks: set[str]) -> list[int] | None:
    """Fractions of a second [ns] from their digits, and from what separates them from the seconds.

    None if they are none: as many digits as milliseconds, microseconds or nanoseconds have are expected, or fewer, if
    no number begins with 0. After a decimal point trailing zeros may be omitted, instead.
    """
    widths = {len(part) for part in parts if part}
    if not widths:
        return [0] * len(parts)
    has_zeros = len(widths) == 1 or any(len(part) > 1 and part[0] == "0" for part in parts)
    if marks <= {".", ","} and (has_zeros or max(widths) < 9):
        return [int(part.ljust(9, "0")) for part in parts]
    if (
        len(marks) > 1
        or (has_zeros and widths not in ({3}, {6}, {9}))
        or ("" in marks and not has_zeros and 9 not in widths)
    ):
        return None
    unit = 10 ** (9 - next(width for width in (3, 6, 9) if width >= max(widths)))
    return [unit * int(part or 0) for part in parts]


def _is_clock(texts: Sequence[str], nanoseconds: Sequence[int]) -> bool:
    """Whether times of day without a date are far more even than the same digits as numbers."""
    numbers = [SECOND * int(_digits(text)) + time % SECOND for text, time in zip(texts, nanoseconds, strict=True)]
    return _unevenness(nanoseconds) < 0.5 * _unevenness(numbers)


def _unevenness(values: Sequence[int]) -> float:
    """Standard deviation of the steps between values, over their mean."""
    steps = [b - a for a, b in pairwise(sorted({*values}))]
    return statistics.pstdev(steps) / statistics.fmean(steps)


def _digits(text: str) -> str:
    return re.sub(r"[^0-9]", "", text)


def _date(match: re.Match[str]) -> int | None:
    """Seconds to a time of day; of any day if none is given."""
    digits = _digits(match.groupdict().get("date", "20000101") + match["clock"])
    try:
        moment = datetime.strptime(digits, "%Y%m%d%H%M%S")
    except ValueError:
        return None
    return 86_400 * moment.toordinal() + 3600 * moment.hour + 60 * moment.minute + moment.second


def _seconds(match: re.Match[str]) -> int:
    return int(match["seconds"])


def _decimal(match: re.Match[str]) -> int | None:
    before = match.string[: match.start()]
    if before[-1:].isalpha() and not AFTER_LETTERS.search(before):
        return None
    return int(match["seconds"])
