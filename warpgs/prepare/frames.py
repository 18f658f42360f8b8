"""Frames of a video or a folder of pictures: evenly spread over time, the sharpest of each interval, scaled down."""

import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # damaged files are told of by us, in one line
import cv2
import numpy as np
from jaxtyping import UInt8

from warpgs.data.images import MAX_SIDE, decode
from warpgs.data.motion_check import MAX_ASPECT, MIN_SIDE
from warpgs.files import write_json, write_png
from warpgs.progress import progress

MIN_FRAMES = 5
MAX_FRAMES = 1000
"""More take more memory than they are worth."""

DEFAULT_FRAMES = 150
"""Taken from a video when neither a rate nor a count is asked for."""

MIN_DECODED_FRACTION = 0.95
"""Share of the frames that a video promises, under which its being cut off is told."""

PICTURES = (".png", ".jpg", ".jpeg")

SHARPNESS_SIDE = 480
"""Sharpness is compared on pictures of this longest side [px]: noise does not count as detail."""


@dataclass(frozen=True)
class SourceFrame:
    """One frame that was taken.

    Attributes:
        name: Its id in the capture.
        source: Where it comes from, for messages: a file's name, or a video's frame number.
        step: Its place in the source, which is its time.
    """

    name: str
    source: str
    step: int


@dataclass(frozen=True)
class Selection:
    """Which frames to take, and their size.

    Attributes:
        fps: Frames a second of a video; None for a count.
        count: Number of frames; None for all of a folder, 150 of a video.
        longest_side: Larger pictures are scaled down to it [px].
    """

    fps: float | None = None
    count: int | None = None
    longest_side: int = 960

    def check(self) -> None:
        """Raises ``ValueError`` if a number is out of range."""
        if self.fps is not None and self.count is not None:
            raise ValueError("--fps and --count exclude each other")
        if self.fps is not None and not 0.0 < self.fps < math.inf:
            raise ValueError(f"--fps must be positive, got {self.fps}")
        if self.count is not None and not MIN_FRAMES <= self.count <= MAX_FRAMES:
            raise ValueError(f"--count must be {MIN_FRAMES} to {MAX_FRAMES}, got {self.count}")
        if not 64 <= self.longest_side <= MAX_SIDE:
            raise ValueError(f"--longest-side must be 64 to {MAX_SIDE} pixels, got {self.longest_side}")


def take_frames(
    source: Path, folder: Path, selection: Selection, quiet: bool = True, notes: list[str] | None = None
) -> list[SourceFrame]:
    """Writes the chosen frames of a video or a folder into ``folder`` as PNG, and frames.json that lists them.

    Args:
        source: Video or folder of pictures.
        folder: Where to write.
        selection: Which frames.
        quiet: Whether to show no progress.
        notes: What to tell the user is appended to it.

    Raises:
        ValueError: If the source is missing, no video, no folder of pictures, or has too few or different frames.
        OSError: If a frame can't be written.
    """
    selection.check()
    if not source.exists():
        raise ValueError(f"{source} is missing: expected a video or a folder of pictures")
    taken: list[SourceFrame] = []
    size = None
    notes = [] if notes is None else notes
    chosen = _of_folder(source, selection, quiet) if source.is_dir() else _of_video(source, selection, quiet, notes)
    for step, origin, image in chosen:
        if size not in (None, image.shape[1::-1]):
            raise ValueError(
                f"{source}: {origin} is {image.shape[1]}×{image.shape[0]}, others are {size[0]}×{size[1]}: "
                "all pictures must be of one camera and size"
            )
        size = image.shape[1::-1]
        image = _scaled(image, selection.longest_side)
        if min(image.shape[:2]) < max(MIN_SIDE, max(image.shape[:2]) / MAX_ASPECT):
            raise ValueError(
                f"{source}: {origin} of {image.shape[1]}×{image.shape[0]} pixels is too flat: the shorter side must "
                f"have at least {MIN_SIDE} pixels and 1/{MAX_ASPECT} of the longer one"
            )
        taken.append(SourceFrame(f"frame_{len(taken):06d}", origin, step))
        write_png(folder / f"{taken[-1].name}.png", image)
    if len(taken) < MIN_FRAMES:
        raise ValueError(
            f"{source} gives {len(taken)} frame{'s' * (len(taken) != 1)}, at least {MIN_FRAMES} are needed"
        )
    write_json(folder / "frames.json", [asdict(frame) for frame in taken])
    return taken


def list_frames(folder: Path) -> list[SourceFrame]:
    """What ``take_frames`` wrote."""
    return [SourceFrame(**facts) for facts in json.loads((folder / "frames.json").read_text())]


def sharpness(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """Variance of the Laplacian of a picture's grey levels (Pech-Pacheco et al. 2000)."""
    grey = cv2.cvtColor(_scaled(image, SHARPNESS_SIDE), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def _scaled(image: np.ndarray, longest: int) -> np.ndarray:
    height, width = image.shape[:2]
    factor = longest / max(width, height)
    if factor >= 1.0:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _of_folder(source: Path, selection: Selection, quiet: bool) -> Iterator[tuple[int, str, np.ndarray]]:
    if selection.fps is not None:
        raise ValueError("--fps is for videos: a folder has no rate, use --count")
    pictures = (p for p in source.iterdir() if p.suffix.lower() in PICTURES and not p.name.startswith("."))
    paths = sorted(pictures, key=_natural)
    if not paths:
        raise ValueError(f"{source} holds no {', '.join(PICTURES)} pictures")
    count = min(selection.count or len(paths), len(paths))
    if count > MAX_FRAMES:
        raise ValueError(f"{source} holds {count} pictures, at most {MAX_FRAMES} are taken: choose with --count")
    groups = np.array_split(np.arange(len(paths)), count)
    for group in progress(groups, "frames", quiet):
        best = max(((k, _picture(paths[k])) for k in group), key=lambda c: sharpness(c[1]) if len(group) > 1 else 0)
        yield int(best[0]), paths[best[0]].name, best[1]


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Sorts shot2 before shot10."""
    parts = re.split(r"([0-9]+)", path.name)  # text and numbers take turns
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], path.name


def _picture(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """An RGB picture, turned as its EXIF data say; damaged and huge files are refused before they are decoded."""
    return cv2.cvtColor(decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _of_video(
    source: Path, selection: Selection, quiet: bool, notes: list[str]
) -> Iterator[tuple[int, str, np.ndarray]]:
    video = _open(source)
    try:
        total, rate = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), video.get(cv2.CAP_PROP_FPS)
        if total <= 0:
            total = _counted(source)
        if selection.fps is not None and not rate > 0:
            raise ValueError(f"{source} does not say its rate: use --count instead of --fps")
        wanted = selection.count or DEFAULT_FRAMES
        interval = rate / selection.fps if selection.fps is not None else total / wanted
        interval = max(1.0, interval)
        if total / interval > MAX_FRAMES:
            raise ValueError(f"{source} gives {int(total / interval)} frames, at most {MAX_FRAMES} are taken")
        yield from _sharpest(source, video, total, interval, quiet, notes)
    finally:
        video.release()


def _sharpest(
    source: Path, video: cv2.VideoCapture, total: int, interval: float, quiet: bool, notes: list[str]
) -> Iterator[tuple[int, str, np.ndarray]]:
    """The sharpest frame of each interval; one frame at a time is held besides the best."""
    best: tuple[float, int, np.ndarray] | None = None
    current = 0
    for step in progress(range(total), "frames", quiet):
        whole, image = video.read()
        if not whole:
            if step < MIN_DECODED_FRACTION * total:  # containers often count a few more than there are
                notes.append(f"{source} promises {total} frames, only {step} could be decoded: is it cut off?")
            break
        if int(step / interval) != current and best is not None:
            yield best[1], f"frame {best[1]}", best[2]
            best, current = None, int(step / interval)
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        score = sharpness(image) if interval > 1.0 else 0.0
        if best is None or score > best[0]:
            best = (score, step, image)
    if best is None:
        raise ValueError(f"{source} is no video that can be decoded: it has no frames")
    yield best[1], f"frame {best[1]}", best[2]


def _open(source: Path) -> cv2.VideoCapture:
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        video = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(before)
    if not video.isOpened():
        raise ValueError(f"{source} is no video that can be decoded, and no folder of pictures")
    size = [video.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    if not 0 < min(size) <= max(size) <= MAX_SIDE:
        video.release()
        raise ValueError(f"{source} claims frames of {size[0]:.0f}×{size[1]:.0f} pixels, at most {MAX_SIDE} a side")
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # phones store upright videos lying, with a tag
    return video


def _counted(source: Path) -> int:
    """The number of frames, by going through a video that does not say."""
    video, count = _open(source), 0
    while count < 1_000_000 and video.grab():
        count += 1
    video.release()
    return count
