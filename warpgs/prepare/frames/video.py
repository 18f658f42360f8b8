"""Reads the frames of a video file with PyAV: the sharpest frame of each interval, with its time; names cuts."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from jaxtyping import UInt8

from warpgs.command_line.progress import progress
from warpgs.data.capture import Side
from warpgs.data.images import MAX_PIXELS, MAX_SIDE
from warpgs.data.resized import size_within
from warpgs.data.video_frames import READ_LOCAL_FILES
from warpgs.files import require_file

from ..options import Selection
from .colors import quarter_turns, to_rgb
from .cuts import CutFinder
from .images import SHARPNESS_SIDE, grey_sharpness
from .timeline import Timeline, plan_timeline

MIN_DECODED_FRACTION = 0.95
"""Fraction of a video's nominal frames below which a note says that it ends early."""

MAX_BYTES = 1 << 42
"""Maximum size of a video [bytes]; it is decoded frame by frame."""

MAX_COUNTED = 1_000_000
"""Maximum number of frames of a video; later ones are ignored."""


TURNED_TOP: tuple[Side, ...] = ("top", "left", "bottom", "right")
"""Where the top of a frame is after a number of quarter turns to the left."""


class TakenImage(NamedTuple):
    """A frame of a video or a folder.

    Attributes:
        step: Its index in the source.
        time: Its time: milliseconds from the first frame of a video; see ``SourceFrame`` for a folder.
        origin: Its origin, for messages.
        image: [H, W, 3] RGB.
        longest_side: Longer side of the frame in the source [px].
        readout_from: Side where the first row of the sensor is, the top before the frame was rotated.
    """

    step: int
    time: int
    origin: str
    image: UInt8[np.ndarray, "H W 3"]
    longest_side: int
    readout_from: Side = "top"


def read_video(source: Path, selection: Selection, quiet: bool, notes: list[str]) -> Iterator[TakenImage]:
    """The sharpest frame of each interval of a video, rotated as it is tagged, in 8-bit sRGB.

    Args:
        source: The video.
        selection: Rate or number of frames, and the part of the video.
        quiet: Whether to show no progress.
        notes: Messages for the user are appended to it: cuts, and a video that ends early.

    Raises:
        ValueError: If it cannot be decoded, has too many frames, no rate, or none in the selected part.
    """
    require_file(source, MAX_BYTES)
    stamps, nominal = time_stamps(source, selection.fps is not None)
    timeline = plan_timeline(str(source), [stamp - stamps[0] for stamp in stamps], selection)
    cuts, decoded, best, current = CutFinder(), 0, (-1.0, Fraction(0), None), -1
    with _open(source) as (container, stream):
        frames = _decode(container, stream, stamps, timeline)
        for _, (time, frame) in zip(progress(timeline.intervals, "frames", quiet), frames, strict=False):
            if timeline.intervals[time] != current:
                if decoded:
                    yield _taken(best[1], best[2], stream, timeline, selection)
                current, best = timeline.intervals[time], (-1.0, time, frame)
            decoded += 1
            grey = _grey(frame)
            cuts.add(timeline.steps[time], float(time), grey)
            best = max(best, (grey_sharpness(grey), time, frame), key=lambda candidate: candidate[0])
        if not decoded:
            raise ValueError(f"{source} is not a video that can be decoded: it has no frames")
        yield _taken(best[1], best[2], stream, timeline, selection)
    expected = len(timeline.intervals) + max(0, nominal - len(stamps))
    if decoded < MIN_DECODED_FRACTION * expected:  # containers often count a few frames too many
        notes.append(f"{source} should have {expected} frames, only {decoded} could be decoded: is it truncated?")
    notes.extend(
        f"{source} has a cut at frame {step} ({time:.2f} s): use --start or --end" for step, time in cuts.found
    )


def _taken(time: Fraction, frame: Any, stream: Any, timeline: Timeline, selection: Selection) -> TakenImage:
    image = to_rgb(frame, int(stream.codec_context.color_trc or 0), selection.longest_side)
    step = timeline.steps[time]
    side = TURNED_TOP[quarter_turns(frame) % 4]
    return TakenImage(step, round(1000 * time), f"frame {step}", image, max(frame.width, frame.height), side)


def _grey(frame: Any) -> UInt8[np.ndarray, "h w"]:
    """[h, w] grey levels of a frame, not rotated, at the size that sharpness is measured at."""
    width, height = size_within((frame.width, frame.height), SHARPNESS_SIDE)
    return frame.reformat(width=width, height=height, format="gray", interpolation="AREA").to_ndarray()


@contextmanager
def _open(source: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its video stream.

    Raises:
        ValueError: If it is not a video, or its frames are too large.
    """
    unusable = ValueError(f"{source} is not a video that can be decoded, and not a folder of frames")
    try:
        container = av.open(str(source), options=READ_LOCAL_FILES)
    except (av.FFmpegError, ValueError) as error:
        raise unusable from error
    with container:
        if not container.streams.video:
            raise unusable
        stream = container.streams.video[0]
        width, height = stream.codec_context.width, stream.codec_context.height
        if not 0 < min(width, height) <= max(width, height) <= MAX_SIDE or width * height > MAX_PIXELS:
            raise ValueError(
                f"{source} claims frames of {width}×{height} pixels, the maximum is {MAX_SIDE} per side and "
                f"{MAX_PIXELS:,} together"
            )
        stream.thread_type = "AUTO"
        yield container, stream


def time_stamps(source: Path, needs_rate: bool = False) -> tuple[list[Fraction], int]:
    """The time stamps of all frames [s], ascending, from the packets, and the number of frames that the file states.

    Raises:
        ValueError: If it is not a video, has no frames, or neither time stamps nor the rate that it ``needs_rate``.
    """
    with _open(source) as (container, stream):
        stamps: list[Fraction | None] = []
        with suppress(av.FFmpegError):  # the packets before the damage are used
            for packet in islice(container.demux(stream), MAX_COUNTED):
                if packet.size and not packet.is_discard:
                    stamps.append(_seconds(packet.pts if packet.pts is not None else packet.dts, stream))
        known = {stamp for stamp in stamps if stamp is not None}
        if len(known) == len(stamps) > 0:
            return sorted(known), stream.frames
        rate = stream.average_rate
        if not stamps:
            raise ValueError(f"{source} is not a video that can be decoded: it has no frames")
        if not rate and needs_rate:
            raise ValueError(f"{source} has no frame rate: use --count instead of --fps")
        return [Fraction(k) / (Fraction(str(rate)) if rate else 1) for k in range(len(stamps))], stream.frames


def _seconds(stamp: int | None, stream: Any) -> Fraction | None:
    return None if stamp is None else stamp * Fraction(str(stream.time_base))


def decoded(container: Any, stream: Any) -> Iterator[Any]:
    """The frames of a stream of images or sound; packets that are damaged are skipped."""
    for packet in container.demux(stream):
        frames: list[Any] = []
        with suppress(av.FFmpegError):
            frames = packet.decode()
        yield from frames


def _decode(container: Any, stream: Any, stamps: list[Fraction], timeline: Timeline) -> Iterator[tuple[Fraction, Any]]:
    """Times and frames of the selected part, in order; damaged frames are skipped."""
    begin = next(iter(timeline.intervals))
    known = set(stamps)
    if begin > 0:
        with suppress(av.FFmpegError):  # then it is decoded from its start
            container.seek(int((begin + stamps[0]) / Fraction(str(stream.time_base))), stream=stream)
    last = Fraction(-1)
    for index, frame in enumerate(decoded(container, stream)):
        stamp = _seconds(frame.pts, stream)
        if stamp not in known:  # no usable time stamps: count
            stamp = stamps[min(index, len(stamps) - 1)]
        time = stamp - stamps[0]
        if time in timeline.intervals and time > last:
            last = time
            yield time, frame
