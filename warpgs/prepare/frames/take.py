"""Frames taken from a video or a folder: evenly spaced over time, the sharpest of each interval, scaled down."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from warpgs.command_line.progress import progress
from warpgs.data.capture import SIDES, Side
from warpgs.data.exif import orientation_of
from warpgs.data.images import MAX_SIDE, decode
from warpgs.data.loaders.name_times import times_of_names
from warpgs.data.optical_flow import MAX_ASPECT, MIN_SIDE
from warpgs.data.time_source import TimeSource
from warpgs.errors import counted
from warpgs.files import natural_order, read_json, write_json, write_png

from ..options import MAX_FRAMES, MIN_FRAMES, Selection, require_source
from .images import resize_to_side, sharpness
from .offsets import Clock
from .stillness import find_background
from .video import TakenImage, read_video

MIN_LONGEST_SIDE = 64
"""Minimum of ``--longest-side`` [px]."""

SUFFIXES = (".png", ".jpg", ".jpeg")

CONVERTIBLE = (".heic", ".heif", ".tif", ".tiff", ".webp", ".avif", ".bmp", ".dng")
"""Suffixes of images that are not read: phones write HEIC."""

PREFIX = "frame"
"""First part of the names of a single camera's frames; the frames of several cameras have the camera's number."""

MAX_TIME = 2**53
"""Maximum of a time, so that double precision represents it."""


FIRST_ROW: tuple[Side, ...] = ("top", "top", "bottom", "bottom", "left", "right", "right", "left")
"""Where the first stored row of an image is once it is upright, of each EXIF orientation from 1 on."""


@dataclass(frozen=True)
class SourceFrame:
    """A frame taken from a source.

    Attributes:
        name: Its id in the capture.
        source: Its origin, for messages: the name of a file, or the frame number in a video.
        step: Its index in the source.
        time: Its time: milliseconds in a video, from the start of the first of several; in a folder seconds,
            milliseconds or numbers that its names tell, else its index.
    """

    name: str
    source: str
    step: int
    time: int


@dataclass(frozen=True)
class Frames:
    """The frames of one camera as recorded, in files <folder>/<name>.png.

    Attributes:
        folder: Folder of the files.
        taken: The frames, in temporal order.
        width, height: Their size [px].
        factor: Their size over that of the source.
        source: The video or folder, for messages.
        is_still: Whether the camera is one of several and stands still; then ``background`` is a file, too.
        readout_from: See ``Capture.readout_from``.
    """

    folder: Path
    taken: list[SourceFrame]
    width: int
    height: int
    factor: float
    source: str = ""
    is_still: bool = False
    readout_from: Side = "top"

    @staticmethod
    def load(folder: Path, prefix: str = PREFIX) -> "Frames":
        """The frames of one camera that ``save`` listed."""
        index = read_json(index_of(folder, prefix))
        taken = [SourceFrame(str(f["name"]), str(f["source"]), int(f["step"]), int(f["time"])) for f in index["frames"]]
        size = int(index["width"]), int(index["height"]), float(index["factor"])
        others = str(index["source"]), bool(index["is_still"]), _side(index)
        return Frames(folder, taken, *size, *others)

    @staticmethod
    def load_all(folder: Path) -> list["Frames"]:
        """The frames of all cameras.

        Raises:
            ValueError: If there are none.
        """
        prefixes = [path.stem.removeprefix("index_") for path in sorted(folder.glob("index_*.json"))]
        if not prefixes:
            raise ValueError(f"{folder} has no index of frames")
        return [Frames.load(folder, prefix) for prefix in prefixes]

    @staticmethod
    def files(folder: Path) -> list[Path]:
        """The files of all cameras' frames; only the index of the first if it is missing or damaged."""
        try:
            cameras = Frames.load_all(folder)
        except (KeyError, TypeError, ValueError):
            return [*sorted(folder.glob("index_*.json")), index_of(folder, PREFIX)][:1]
        return [path for camera in cameras for path in camera._files()]

    def save(self) -> None:
        """Lists the frames in a file of their folder."""
        index = {**asdict(self), "frames": [asdict(frame) for frame in self.taken]}
        write_json(index_of(self.folder, self.prefix), {k: v for k, v in index.items() if k not in ("folder", "taken")})

    def _files(self) -> list[Path]:
        images = [*self.names, *([self.background] if self.is_still else [])]
        return [index_of(self.folder, self.prefix), *(self.folder / f"{name}.png" for name in images)]

    @property
    def prefix(self) -> str:
        """First part of the frames' names."""
        return self.taken[0].name.rpartition("_")[0]

    @property
    def background(self) -> str:
        """Name of the image of a camera that stands still without anything that moves."""
        return f"{self.prefix}_background"

    @property
    def names(self) -> list[str]:
        """Ids of the frames, in order."""
        return [frame.name for frame in self.taken]

    def megabytes(self, bytes_per_pixel: int) -> int:
        """Disk space for this number of bytes per pixel of all frames, rounded up [MB]."""
        return len(self.taken) * self.width * self.height * bytes_per_pixel // 1_000_000 + 1


def _side(index: dict[str, Any]) -> Side:
    side = index.get("readout_from", "top")
    if side not in SIDES:
        raise ValueError(f"readout_from must be one of {', '.join(SIDES)}, got {side!r}")
    return side


def check_selection(selection: Selection) -> None:
    """Checks the ranges of a selection.

    Raises:
        ValueError: If a value is out of range.
    """
    if selection.fps is not None and selection.count is not None:
        raise ValueError("--fps and --count exclude each other")
    if selection.fps is not None and not 0.0 < selection.fps < math.inf:
        raise ValueError(f"--fps must be positive, got {selection.fps}")
    if selection.count is not None and not MIN_FRAMES <= selection.count <= MAX_FRAMES:
        raise ValueError(f"--count must be {MIN_FRAMES} to {MAX_FRAMES}, got {selection.count}")
    if not 0.0 <= selection.start < math.inf:
        raise ValueError(f"--start must be at least 0 seconds, got {selection.start}")
    if selection.end is not None and not selection.start < selection.end < math.inf:
        raise ValueError(f"--end must be after --start ({selection.start:g} s), got {selection.end}")
    if not MIN_LONGEST_SIDE <= selection.longest_side <= MAX_SIDE:
        raise ValueError(
            f"--longest-side must be {MIN_LONGEST_SIDE} to {MAX_SIDE} pixels, got {selection.longest_side}"
        )


def index_of(folder: Path, prefix: str) -> Path:
    """The file that lists the frames of a camera."""
    return folder / f"index_{prefix}.json"


def take_frames(
    source: Path,
    folder: Path,
    selection: Selection,
    quiet: bool = True,
    notes: list[str] | None = None,
    prefix: str = PREFIX,
) -> Frames:
    """Writes the selected frames of a video or a folder as PNG, and a file that lists them.

    Messages for the user are appended to ``notes``; the names of the frames begin with the prefix.

    Raises:
        ValueError: If the source is missing, is not a video or folder of images, or has too few or different frames.
        OSError: If a frame cannot be written.
    """
    check_selection(selection)
    require_source(source)
    notes = [] if notes is None else notes
    images = (
        read_folder(source, selection, quiet, notes) if source.is_dir() else read_video(source, selection, quiet, notes)
    )
    taken, sides = list[SourceFrame](), list[Side]()
    size: tuple[int, int] | None = None
    for found in images:
        sides.append(found.readout_from)
        size = size or found.image.shape[1::-1]
        image = _checked(found.image, f"{source}: {found.origin}", size, selection.longest_side)
        taken.append(SourceFrame(f"{prefix}_{len(taken):06d}", found.origin, found.step, found.time))
        write_png(folder / f"{taken[-1].name}.png", image)
    if len(taken) < MIN_FRAMES:
        raise ValueError(f"{source} gives {counted(len(taken), 'frame')}, at least {MIN_FRAMES} are needed")
    height, width = image.shape[:2]
    size, factor = (width, height), max(width, height) / found.longest_side
    frames = Frames(folder, taken, *size, factor, str(source), readout_from=_common_side(sides, str(source), notes))
    frames.save()
    return frames


def _common_side(sides: Sequence[Side], source: str, notes: list[str]) -> Side:
    """The side of most frames; a note for the user if others have another one."""
    side = max(dict.fromkeys(sides), key=sides.count)
    if (others := len(sides) - sides.count(side)) > 0:
        notes.append(
            f"{source}: {counted(others, 'frame')} of {len(sides)} {'was' if others == 1 else 'were'} filmed with the "
            f"camera held differently; a rolling shutter (--readout) begins at the {side} of the others"
        )
    return side


def take_videos(
    sources: Sequence[Path],
    folder: Path,
    selection: Selection,
    clock: Clock,
    quiet: bool = True,
    notes: list[str] | None = None,
) -> list[Frames]:
    """Writes the selected frames of several videos of one event, and of each camera that stands still its background.

    The selection is from the time that all of them show; other arguments and errors as for ``take_frames``.
    """
    check_selection(selection)
    digits, cameras = len(str(len(sources) - 1)), []
    for k, source in enumerate(sources):
        own = clock.selection(k, selection)
        frames = take_frames(source, folder, own, quiet, notes, f"{k:0{digits}}")
        later = round(1000 * clock.starts[k])
        frames = replace(frames, taken=[replace(frame, time=frame.time + later) for frame in frames.taken])
        if (background := find_background(folder, frames.names)) is not None:
            frames = replace(frames, is_still=True)
            write_png(folder / f"{frames.background}.png", background)
        frames.save()
        cameras.append(frames)
    return cameras


def _checked(image: np.ndarray, origin: str, size: tuple[int, int], longest_side: int) -> np.ndarray:
    """The image, scaled down, if it has the ``size`` of the first and is not too flat for optical flow."""
    if image.shape[1::-1] != size:
        raise ValueError(
            f"{origin} is {image.shape[1]}×{image.shape[0]}, others are {size[0]}×{size[1]}: "
            "all images must be of one camera and size"
        )
    image = resize_to_side(image, longest_side, max_factor=1.0)
    height, width = image.shape[:2]
    if min(height, width) < max(MIN_SIDE, max(height, width) / MAX_ASPECT):
        raise ValueError(
            f"{origin} of {width}×{height} pixels is too flat: the shorter side must have at least {MIN_SIDE} pixels "
            f"and 1/{MAX_ASPECT} of the longer one"
        )
    return image


def read_folder(source: Path, selection: Selection, quiet: bool, notes: list[str]) -> Iterator[TakenImage]:
    """The sharpest image of each interval of a folder; appends to ``notes`` where unusual times come from.

    Raises:
        ValueError: If it has no images or too many, or one is damaged.
    """
    if selection.fps is not None:
        raise ValueError("--fps is for videos: a folder has no frame rate, use --count")
    if selection.start or selection.end is not None:
        raise ValueError("--start and --end are for videos: a folder has no times")
    paths = sorted(filter(_is_image, source.iterdir()), key=lambda path: natural_order(path.name))
    if not paths:
        inside = next((p.parent for p in sorted(source.glob("[!.]*/*")) if _is_image(p)), None)
        others = {path.suffix for path in source.iterdir() if path.suffix.lower() in CONVERTIBLE}
        advice = f": convert its {', '.join(sorted(others))} files to PNG or JPEG" if others else ""
        advice = f", but {inside} does" if inside else advice
        raise ValueError(f"{source} holds no {', '.join(SUFFIXES)} images{advice}")
    count = min(selection.count or len(paths), len(paths))
    if count > MAX_FRAMES:
        raise ValueError(f"{source} holds {count} images, the maximum is {MAX_FRAMES}: choose with --count")
    paths, times = _in_order_of_time(paths, notes)
    groups = np.array_split(np.arange(len(paths)), count)
    for group in progress(groups, "frames", quiet):
        best = max(((k, _read(paths[k])) for k in group), key=lambda c: sharpness(c[1]) if len(group) > 1 else 0)
        path, image = paths[best[0]], best[1]
        side = FIRST_ROW[orientation_of(path) - 1]
        yield TakenImage(int(best[0]), times[best[0]], path.name, image, max(image.shape[:2]), side)


def _in_order_of_time(paths: Sequence[Path], notes: list[str]) -> tuple[list[Path], list[int]]:
    """Images in the order of time, and their times, which their names tell; see ``SourceFrame``.

    Args:
        paths: Images in the order of their names.
        notes: Receives where the times come from, unless they count the images.
    """
    named, source, are_read, _ = times_of_names([path.name for path in paths])
    scale = 1 if all(time.is_integer() for time in named) else 1000
    times = [round(scale * time) for time in named]
    if len({*times}) < len(times) or max(times) > MAX_TIME:
        are_read, source = (
            False,
            TimeSource("times from the sorted order of the names", "some names have the same time"),
        )
    if not are_read:
        times = [*range(len(times))]
    order = sorted(range(len(times)), key=times.__getitem__)
    if source.problem or [times[k] for k in order] != [*range(len(times))]:
        notes.append(str(source))
    return [paths[k] for k in order], [times[k] for k in order]


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def _read(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """An RGB image, rotated according to its EXIF data; damaged and huge files are refused before decoding."""
    return cv2.cvtColor(decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
