"""Reads the frames of a video file: the sharpest frame of each interval."""

import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # damaged files are reported below, in one line
import cv2
import numpy as np

from warpgs.data.images import MAX_SIDE
from warpgs.files import require_file
from warpgs.progress import progress

from .images import sharpness
from .options import MAX_FRAMES, Selection

DEFAULT_FRAMES = 150
"""Number of frames taken from a video if neither a rate nor a number is given."""

MIN_DECODED_FRACTION = 0.95
"""Fraction of a video's nominal frames below which a note says that it ends early."""

MAX_BYTES = 1 << 42
"""Maximum size of a video [bytes]; it is decoded frame by frame."""

MAX_COUNTED = 1_000_000
"""Frames after which counting stops."""

TakenImage = tuple[int, str, np.ndarray]
"""Index in the source, origin for messages, and [H, W, 3] RGB image."""


def read_video(source: Path, selection: Selection, quiet: bool, notes: list[str]) -> Iterator[TakenImage]:
    """The sharpest frame of each interval of a video.

    Args:
        source: The video.
        selection: Rate or number of frames.
        quiet: Whether to show no progress.
        notes: Messages for the user are appended to it.

    Raises:
        ValueError: If it cannot be decoded, or has too many frames or no rate.
    """
    video = _open(source)
    try:
        total, rate = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), video.get(cv2.CAP_PROP_FPS)
        if total <= 0:
            total = _count_frames(source)
        if selection.fps is not None and not rate > 0:
            raise ValueError(f"{source} has no frame rate: use --count instead of --fps")
        wanted = selection.count or DEFAULT_FRAMES
        interval = rate / selection.fps if selection.fps is not None else total / wanted
        interval = max(1.0, interval)
        if total / interval > MAX_FRAMES:
            raise ValueError(f"{source} gives {int(total / interval)} frames, the maximum is {MAX_FRAMES}")
        yield from _sharpest(source, video, total, interval, quiet, notes)
    finally:
        video.release()


def _sharpest(
    source: Path, video: cv2.VideoCapture, total: int, interval: float, quiet: bool, notes: list[str]
) -> Iterator[TakenImage]:
    """The sharpest frame of each interval; keeps only the best and the current frame in memory."""
    best: tuple[float, int, np.ndarray] | None = None
    current = 0
    for step in progress(range(total), "frames", quiet):
        decoded, image = video.read()
        if not decoded:
            if step < MIN_DECODED_FRACTION * total:  # containers often count a few frames too many
                notes.append(f"{source} should have {total} frames, only {step} could be decoded: is it truncated?")
            break
        if int(step / interval) != current and best is not None:
            yield best[1], f"frame {best[1]}", best[2]
            best, current = None, int(step / interval)
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        score = sharpness(image) if interval > 1.0 else 0.0
        if best is None or score > best[0]:
            best = (score, step, image)
    if best is None:
        raise ValueError(f"{source} is not a video that can be decoded: it has no frames")
    yield best[1], f"frame {best[1]}", best[2]


def _open(source: Path) -> cv2.VideoCapture:
    require_file(source, MAX_BYTES)
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        video = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(before)
    if not video.isOpened():
        raise ValueError(f"{source} is not a video that can be decoded, and not a folder of frames")
    size = [video.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    if not 0 < min(size) <= max(size) <= MAX_SIDE:
        video.release()
        raise ValueError(f"{source} claims frames of {size[0]:.0f}×{size[1]:.0f} pixels, the maximum is {MAX_SIDE}")
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # phones store upright videos rotated, with a tag
    return video


def _count_frames(source: Path) -> int:
    """The number of frames of a video that does not state it."""
    video, count = _open(source), 0
    while count < MAX_COUNTED and video.grab():
        count += 1
    video.release()
    return count
