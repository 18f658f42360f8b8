"""Short trainings that tell whether estimated masks help: masks that miss much of what moves are worse than none."""

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from warpgs.config import TrainConfig, scaled
from warpgs.data.capture import Assumption, Capture
from warpgs.evaluation.metrics import psnr

from . import ranks
from .fitting import fitted
from .logger import TrainingLogger
from .trainer import Trainer

HELD_OUT = 8
"""Every so many training frames, one is held out of a trial."""

MIN_FRAMES = 16
"""Minimum number of training frames for a trial; two of them are held out."""

MIN_GAIN = 0.1
"""By how much held-out frames must be better without masks, because without them nothing is static [dB]."""


def with_trusted_masks(config: TrainConfig, capture: Capture, log: Callable[[str], None], quiet: bool) -> TrainConfig:
    """The config, which takes everything as dynamic if estimated masks turn out to be worse than none.

    All ranks of torchrun must call it; rank 0 decides.

    Args:
        config: Config of a new run, whose schedule is rescaled already.
        capture: Its capture.
        log: Receives what was tried and what follows.
        quiet: Whether to show no progress.
    """
    if config.schedule.mask_trial == 0 or config.assume != "masks" or not capture.estimated_masks:
        return config
    if len(capture.train) < MIN_FRAMES:
        return config
    log(f"the masks are estimates: {config.schedule.mask_trial} iterations with them, and as many without, as a trial")
    following, ignoring = (held_out_psnr(config, capture, assume, quiet) for assume in ("masks", "dynamic"))
    are_worse = bool(ranks.text_of_first("worse" if ignoring > following + MIN_GAIN else ""))
    conclusion = "so they are not used: everything is dynamic" if are_worse else "so they are used"
    log(f"frames held out of the trial have {following:.2f} dB with the masks and {ignoring:.2f} without, {conclusion}")
    return dataclasses.replace(config, assume="dynamic") if are_worse else config


def held_out_psnr(config: TrainConfig, capture: Capture, assume: Assumption, quiet: bool = True) -> float:
    """PSNR of held-out training frames after a short training, mean [dB].

    The training is that of the run in ``schedule.mask_trial`` iterations, without corrections of poses: held-out frames
    have none.

    Args:
        config: Config of the run, whose schedule is rescaled already.
        capture: Its capture.
        assume: What is taken as dynamic.
        quiet: Whether to show no progress.
    """
    names = capture.train
    held_out = names[HELD_OUT // 2 :: HELD_OUT]
    part = capture.split([name for name in names if name not in held_out], held_out)
    optim = dataclasses.replace(config.optim, poses=0.0)
    short = dataclasses.replace(config, iterations=config.schedule.mask_trial, optim=optim, assume=assume)
    with tempfile.TemporaryDirectory(prefix="warpgs-trial-") as folder:
        trainer = Trainer(fitted(scaled(short), part, _ignore), part, Path(folder))
        with TrainingLogger(None, trainer.protocol.num_iterations, 0, quiet) as logger:
            trainer.train(logger)
    trainer.step.release_graphs()
    scene, values = trainer.trained_scene(), []
    for frame in map(trainer.capture.frame, held_out):
        with torch.no_grad():
            image = scene.render(frame.camera).joint.image.clamp(0, 1)
        values.append(psnr(image, frame.image.to(image.device).float() / 255.0))
    return sum(values) / len(values)


def _ignore(text: str) -> None:
    """A log that discards its lines."""
