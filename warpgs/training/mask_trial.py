"""Two short trainings that tell whether estimated masks help: if they miss much of what moves, none are better."""

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path

from warpgs.config import TrainConfig
from warpgs.data.capture import Assumption, Capture
from warpgs.data.resized import reduced_capture
from warpgs.presets import PRESETS

from . import ranks
from .callbacks import Progress, render_and_compare
from .fitting import fitted
from .logger import TrainingLogger
from .trainer import Trainer

TRIAL = PRESETS["quick"]
"""Preset of the trial. At this length and size the order of results is that of the preset best; shorter trials mislead,
because one deformed set of Gaussians learns more slowly than two (docs/design/real-captures.md)."""

MAX_SIDE = 256
"""Maximum side of the trial's images [px]."""

HELD_OUT = 8
"""One of this many training frames is held out of a trial."""

MIN_FRAMES = 16
"""Minimum number of training frames for a trial; two of them are held out."""

MIN_GAIN = 0.5
"""By how much held-out frames must be better without the masks, because without them nothing is static [dB]."""


def with_trusted_masks(config: TrainConfig, capture: Capture, log: Callable[[str], None], quiet: bool) -> TrainConfig:
    """The config, which takes everything as dynamic if estimated masks turn out to be worse than none.

    All ranks of torchrun must call it; rank 0 decides.

    Args:
        config: Config of a new run, with the device chosen.
        capture: Its capture.
        log: Receives what is tried and what follows.
        quiet: Whether to show no progress.
    """
    is_wanted = config.try_masks and capture.assuming(config.assume).uses_estimated_masks
    if not is_wanted or len(capture.train) < MIN_FRAMES:
        return config
    log("the masks are estimates: two short trainings, with the masks and without, tell whether they help")
    small = reduced_capture(capture, MAX_SIDE)
    following, ignoring = (held_out_psnr(config, small, assume, quiet) for assume in ("masks", "dynamic"))
    found = f"frames held out of them have {following:.1f} dB with the masks and {ignoring:.1f} dB without"
    if not ranks.text_of_first("worse" if ignoring > following + MIN_GAIN else ""):
        log(f"{found}: the masks are used")
        return config
    log(f"{found}: the masks are not used, everything is dynamic (--no-try-masks uses them all the same)")
    return dataclasses.replace(config, assume="dynamic")


def held_out_psnr(config: TrainConfig, capture: Capture, assume: Assumption, quiet: bool = True) -> float:
    """PSNR of held-out training frames after a short training, mean [dB].

    Args:
        config: Config of the run, with the device chosen; the trial has its switches.
        capture: Its capture.
        assume: What is taken as dynamic.
        quiet: Whether to show no progress.
    """
    parts = {name: getattr(TRIAL, name) for name in ("model", "loss", "optim", "densify", "schedule")}
    config = dataclasses.replace(config, **parts, iterations=None, assume=assume)
    held_out = capture.train[HELD_OUT // 2 :: HELD_OUT]
    capture = capture.split([name for name in capture.train if name not in held_out], held_out)
    values: list[float] = []

    def compare(progress: Progress) -> None:
        """Compares the held-out frames once training is done."""
        if progress.status.iteration == progress.num_iterations:
            frames = map(progress.capture.frame, held_out)
            values.extend(render_and_compare(progress.scene, frame)[1] for frame in frames)

    with tempfile.TemporaryDirectory(prefix="warpgs-trial-") as folder:
        trainer = Trainer(fitted(config, capture, _ignore), capture, Path(folder))
        trainer.callbacks = [compare]
        with TrainingLogger(None, trainer.protocol.num_iterations, 0, quiet) as logger:
            trainer.train(logger)
    trainer.step.release_graphs()
    return sum(values) / len(values)


def _ignore(text: str) -> None:
    """A log that discards its lines."""
