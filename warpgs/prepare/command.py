"""The commands ``warpgs prepare`` and ``warpgs sample``."""

from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from warpgs.errors import ending_at_once, terminable

from .options import CameraMotion, LensModel, Options, Selection

USED_BY_ADD = ("source", "add", "masks", "depth", "weights", "quiet")
"""Options that mean something with ``--add``."""


@dataclass(frozen=True)
class Prepare:
    """Makes a capture in the NeRF-DS layout from a video or a folder of frames in temporal order.

    After an interruption or an error, the same command continues with the first unfinished step. With ``--add``, adds
    what a capture lacks, with its own cameras: ``warpgs prepare CAPTURE --add masks,depth,points``.
    """

    source: Annotated[Path, tyro.conf.arg(metavar="SOURCE"), tyro.conf.Positional]
    """Video, or folder of PNG or JPEG frames of one size; with --add the capture."""
    capture: Annotated[Path | None, tyro.conf.arg(metavar="CAPTURE"), tyro.conf.Positional] = None
    """Folder to write the capture to; not with --add."""
    add: str | None = None
    """Add these to a capture that lacks them: masks, depth and points, separated by commas."""
    fps: float | None = None
    """Frames per second to take from a video; the sharpest frame of each interval is taken."""
    count: int | None = None
    """Number of frames to take; by default all frames of a folder and 150 of a video."""
    start: float = 0.0
    """Take frames from this time of a video on [s]."""
    end: float | None = None
    """Take frames up to this time of a video [s]."""
    longest_side: int = 960
    """Larger frames are scaled down to this [px]."""
    lens: LensModel = "SIMPLE_RADIAL"
    """COLMAP's lens model."""
    focal: float | None = None
    """Known focal length [px of the source's frames]; found by default."""
    intrinsics: Path | None = None
    """File of the known lens: COLMAP's cameras.txt, or JSON, YAML or XML of OpenCV; instead of --lens and --focal."""
    camera: CameraMotion = "moving"
    """moving, turning (on the spot) or still (on a tripod). The last two give no depth, and no views from elsewhere."""
    masks: str = "motion"
    """How to find what moves: motion, sam2 (motion refined by a network), none, or a folder of masks (0 = dynamic)
    named like the source's files or like the capture's frames."""
    depth: str | None = None
    """How to estimate depth: flow (static surfaces, by optical flow; the default of a moving camera), anything (all
    pixels, by a network) or none."""
    holdout: int = 0
    """Keep every N-th frame for evaluation (val_ids); 0 keeps none."""
    weights: Path | None = None
    """Folder with the networks' weights; by default the Hugging Face cache. Nothing is downloaded."""
    force: bool = False
    """Replace an existing capture."""
    quiet: bool = False
    """Print errors only."""

    def run(self) -> None:
        log = None if self.quiet else partial(print, flush=True)
        if self.add is not None:
            with ending_at_once():
                from .add import AddOptions, add_parts
            self._check_alone()
            add_parts(self.source, AddOptions(self.add.split(","), self.masks, self.depth or "flow", self.weights), log)
            return
        if self.capture is None:
            raise ValueError("prepare needs a source and a folder for the capture, or a capture and --add")
        with ending_at_once():
            from .pipeline import prepare  # imports OpenCV, SciPy and COLMAP
        selection = Selection(self.fps, self.count, self.longest_side, self.start, self.end)
        names = (field.name for field in fields(Options) if field.name != "selection")
        options = Options(selection, **{name: getattr(self, name) for name in names})
        try:
            with terminable():
                prepare(self.source, self.capture, options, force=self.force, log=log)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("interrupted; run the same command again to continue") from None

    def _check_alone(self) -> None:
        """Refuses what --add has no use for."""
        if self.capture is not None:
            raise ValueError(f"with --add, give the capture only, without {self.capture}")
        for field in fields(self):
            if field.name not in USED_BY_ADD and getattr(self, field.name) != field.default:
                raise ValueError(
                    f"--{field.name.replace('_', '-')} cannot be used with --add, which keeps the frames and cameras"
                )


@dataclass(frozen=True)
class Sample:
    """Writes a short ray-traced video, as a hand-held camera records it, to try ``warpgs prepare`` on."""

    video: Annotated[Path, tyro.conf.arg(metavar="VIDEO"), tyro.conf.Positional]
    """File to write, such as sample.mp4."""
    quiet: bool = False
    """Print errors only."""

    def run(self) -> None:
        with ending_at_once():
            from .sample import write_sample  # imports torch and Warp
        log = None if self.quiet else partial(print, flush=True)
        write_sample(self.video, log=log)
        if log is not None:
            log(f"{self.video} is finished: next run warpgs prepare {self.video} CAPTURE --holdout 8")
