"""The commands ``warpgs prepare`` and ``warpgs sample``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from warpgs.command_line.screen import show
from warpgs.errors import command, ending_at_once, terminable

from .options import Options

USED_BY_ADD = ("source", "add", "options", "masks", "depth", "weights", "quiet")
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
    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    force: bool = False
    """Replace an existing capture of prepare; other files are kept."""
    quiet: bool = False
    """Print errors only."""

    def run(self) -> None:
        log = None if self.quiet else show
        if self.add is not None:
            with ending_at_once():
                from .add import AddOptions, add_parts
            self._check_alone()
            masks, depth, weights = self.options.masks, self.options.depth or "flow", self.options.weights
            add_parts(self.source, AddOptions(self.add.split(","), masks, depth, weights), log)
            return
        if self.capture is None:
            raise ValueError("prepare needs a source and a folder for the capture, or a capture and --add")
        with ending_at_once():
            from .pipeline import prepare  # imports OpenCV, SciPy and COLMAP
        try:
            with terminable():
                prepare(self.source, self.capture, self.options, force=self.force, log=log)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("interrupted; run the same command again to continue") from None

    def _check_alone(self) -> None:
        """Refuses what --add has no use for."""
        if self.capture is not None:
            raise ValueError(f"with --add, give the capture only, without {self.capture}")
        plain = Prepare(self.source)
        for given, default in (
            (self.options.selection, plain.options.selection),
            (self.options, plain.options),
            (self, plain),
        ):
            for name, value in vars(default).items():
                if name not in USED_BY_ADD and getattr(given, name) != value:
                    option = f"--{name.replace('_', '-')}"
                    raise ValueError(f"{option} cannot be used with --add, which keeps the frames and cameras")


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
        log = None if self.quiet else show
        write_sample(self.video, log=log)
        if log is not None:
            log(f"{self.video} is finished: next run {command('prepare', self.video, 'CAPTURE', '--holdout', 8)}")
