"""The commands ``warpgs prepare`` and ``warpgs check``."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.data.check import check_capture

from .frames import Selection
from .options import LensModel, Options


@dataclass(frozen=True)
class Prepare:
    """Makes a capture in the layout of NeRF-DS of a video or a folder of pictures in the order of time.

    Interrupted or failed, it goes on where it stopped when it is run again.
    """

    source: tyro.conf.Positional[Path]
    """Video, or folder of PNG or JPEG pictures of one size."""
    capture: tyro.conf.Positional[Path]
    """Folder to make."""
    fps: float | None = None
    """Frames to take of each second of a video; the sharpest of each interval."""
    count: int | None = None
    """Frames to take instead; all of a folder and 150 of a video if neither is given."""
    longest_side: int = 960
    """Larger pictures are scaled down to this [px]."""
    lens: LensModel = "SIMPLE_RADIAL"
    """COLMAP's model of the lens."""
    masks: str = "motion"
    """What moves: found by motion, that followed by a network (sam2), none, or a folder of masks, 0 = moving, named as
    the source's pictures or as the capture's frames."""
    depth: Literal["flow", "anything", "none"] = "flow"
    """Depth of the static scene by optical flow between frames, of all by a network (anything), or none."""
    holdout: int = 0
    """Every so many-th frame is kept for evaluation, as val_ids; 0 keeps none."""
    weights: Path | None = None
    """Folder of the networks' weights; the Hugging Face cache if not given. Nothing is downloaded."""
    force: bool = False
    """Replaces a capture that is there."""
    quiet: bool = False
    """Says nothing but errors."""

    def run(self) -> None:
        from .pipeline import Preparation  # takes half a second that the other commands do without

        selection = Selection(self.fps, self.count, self.longest_side)
        options = Options(self.source, selection, self.lens, self.masks, self.depth, self.holdout, self.weights)
        preparation = Preparation(self.capture, options, self.force, self.quiet)
        was_finished = preparation.attempt.is_finished
        try:
            report = preparation.run()
        except KeyboardInterrupt:
            print("warpgs: stopped; the same command goes on from here", file=sys.stderr)
            raise SystemExit(130) from None
        if self.quiet:
            return
        for note in report["notes"]:
            print(f"note: {note}")
        if was_finished:
            print(f"{self.capture} is finished already; --force makes it anew")
        else:
            sheets = "masks.png" if self.depth == "none" else "masks.png and depth.png"
            print(f"{self.capture} is made: look at {sheets} in it, then run warpgs check {self.capture}")


@dataclass(frozen=True)
class Check:
    """Says whether a capture is fit to train on; exit code 1 if training would be in vain."""

    capture: tyro.conf.Positional[Path]
    """Folder with dataset.json."""
    dataset: str | None = None
    """Its layout; recognised from its files if not given."""
    factor: int | None = None
    """Downscaling of the pictures; the dataset's usual one if not given."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Prints JSON."""

    def run(self) -> None:
        report = check_capture(self.capture, self.dataset, self.factor)
        print(json.dumps(report.plain(), indent=2) if self.as_json else report)
        if not report.is_fit:
            raise SystemExit(1)
