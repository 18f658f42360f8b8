"""Options of ``warpgs prepare``."""

from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.errors import similar_path

LensModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"
]
"""COLMAP's lens models that a capture's cameras can represent."""

CameraMotion = Literal["moving", "turning", "still"]
"""How the camera moves: to other places, only in its direction, or not at all."""

MIN_FRAMES = 5
MAX_FRAMES = 1000
"""Minimum and maximum number of frames of a capture; more take more memory than they are worth."""

PARTS = ("masks", "depth", "points", "tracks")
"""What can be added."""


@dataclass(frozen=True)
class AddOptions:
    """How to add parts.

    Attributes:
        parts: Members of ``PARTS``.
        masks: A name in ``masks.MASKERS``, not "none", or a file or folder that ``data/results/masks.py`` reads.
        depth: A name in ``depth.DEPTHS``, not "none", or a file or folder that ``data/results/depth.py`` reads.
        weights: Folder with the weights of the networks; None for the Hugging Face cache.
        tracks: A file or folder that ``data/results/tracks.py`` reads.
    """

    parts: Sequence[str]
    masks: str = "motion"
    depth: str = "flow"
    weights: Path | None = None
    tracks: Path | None = None


@dataclass(frozen=True)
class Selection:
    """Which frames to take from a source, and their size."""

    fps: float | None = None
    """Frames per second to take from a video; the sharpest frame of each interval is taken."""
    count: int | None = None
    """Number of frames to take of each source; by default all frames of a folder and 150 of a video."""
    longest_side: int = 960
    """Larger frames are scaled down to this [px]."""
    start: float = 0.0
    """Take frames from this time of a video on [s]; of several, of the time that all of them show."""
    end: float | None = None
    """Take frames up to this time of a video [s]."""


@dataclass(frozen=True)
class Options:
    """How to make a capture from a source."""

    selection: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)
    lens: LensModel = "SIMPLE_RADIAL"
    """COLMAP's lens model; EQUIRECTANGULAR for 360° videos."""
    focal: float | None = None
    """Known focal length [px of the source's frames]; found by default."""
    intrinsics: Path | None = None
    """File of the known lens: COLMAP's cameras.txt, or JSON, YAML or XML of OpenCV; instead of --lens and --focal."""
    camera: CameraMotion = "moving"
    """moving, turning (on the spot) or still (on a tripod). The last two give no depth, and no views from elsewhere. Of
    several cameras, each may move or stand still."""
    masks: str = "motion"
    """How to find what moves: motion, sam2 (motion refined by a network), none, or a folder of masks (0 = dynamic; ids
    of objects in PNG files with a palette) named like the source's files or like the capture's frames. With --add also
    an .npz file of masks."""
    depth: str | None = None
    """How to estimate depth: flow (static surfaces, by optical flow; the default of a moving camera), anything (all
    pixels, by a network) or none. With --add also results of Depth Anything 3, VGGT or MoGe: a file or a folder."""
    holdout: int = 0
    """Keep every N-th frame of each camera for evaluation (val_ids); 0 keeps none."""
    holdout_camera: Annotated[tuple[str, ...], tyro.conf.arg(metavar="VIDEO …")] = ()
    """Keep all frames of these of several videos for evaluation, and of the others those of --holdout or none."""
    weights: Path | None = None
    """Folder with the networks' weights; by default the Hugging Face cache. Nothing is downloaded."""
    offset: str | None = None
    """When each of several videos starts [s], in their order and separated by commas, such as 0,0.37,1.2; found from
    their sound by default."""

    @property
    def offsets(self) -> list[float] | None:
        """The numbers of ``offset``.

        Raises:
            ValueError: If they are no numbers.
        """
        try:
            return None if self.offset is None else [float(part) for part in self.offset.split(",")]
        except ValueError:
            raise ValueError(f"--offset must be numbers of seconds, separated by commas, got {self.offset}") from None

    @property
    def has_panoramas(self) -> bool:
        """Whether frames are of 360°."""
        return self.lens == "EQUIRECTANGULAR"

    @property
    def depth_method(self) -> str:
        """The name in ``depth.DEPTHS``."""
        return self.depth or ("flow" if self.camera == "moving" else "none")


@dataclass(frozen=True)
class Prepare:
    """Makes a capture in the NeRF-DS layout from a video, a folder of frames in temporal order, or videos of one event.

    After an interruption or an error, the same command continues with the first unfinished step. With ``--add``, adds
    what a capture lacks, with its own cameras: ``warpgs prepare CAPTURE --add masks,depth,points``.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="SOURCE [VIDEOS] CAPTURE"), tyro.conf.Positional]
    """Video, or folder of PNG or JPEG frames of one size, or several videos, each of a camera of its own; then the
    folder to write the capture to. With --add the capture alone."""
    add: str | None = None
    """Add these to a capture that lacks them: masks, depth, points and tracks, separated by commas."""
    tracks: Path | None = None
    """With --add tracks, the .npz file of CoTracker, TAPIR or SpatialTracker, or a folder of optical flow, for the
    capture's frames in full size."""
    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    force: bool = False
    """Replace an existing capture of prepare; other files are kept."""
    quiet: bool = False
    """Print errors only."""


def require_source(source: Path) -> None:
    """Raises ValueError if there is no such video or folder of images."""
    if not source.exists():
        raise ValueError(f"{source} is missing: expected a video or a folder of images{similar_path(source)}")


def unread(value: str, methods: Container[str], files: str) -> str:
    """The end of a line that says that a file of a network was not read, because the capture has results."""
    return "" if value in methods else f"; {value} was not read: delete {files} first to replace what is there"
