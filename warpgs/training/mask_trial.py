"""Two short trainings that tell whether estimated masks help: if they miss much of what moves, none are better."""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from warpgs.command_line.interrupt import Interrupt
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS
from warpgs.data.capture import Assumption, Capture
from warpgs.data.resized import reduced_capture
from warpgs.errors import one_line
from warpgs.evaluation.held_out import render_and_compare
from warpgs.initialization.prepare_start import prepare_start
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.progress import Progress
from warpgs.runtime import ranks

from .trainer import Trainer

TRIAL = PRESETS["quick"]
"""Preset of the trial. Shorter trials mislead, because one deformed set of Gaussians learns more slowly than two
(docs/design/motion-masks.md)."""

MIN_RELATIVE_LENGTH = 2.0
"""Minimum number of iterations of the run, relative to one of the two trainings."""

MAX_SIDE = 256
"""Maximum side of the trial's images [px]."""

HELD_OUT = 8
"""One of this many training frames is held out of a trial."""

MIN_FRAMES = 16
"""Minimum number of training frames for a trial; two of them are held out."""


def with_trusted_masks(
    config: TrainConfig, capture: Capture, log: Callable[[str], None], quiet: bool
) -> tuple[TrainConfig, dict[str, float]]:
    """The config, which takes everything as dynamic if estimated masks turn out to be worse than none.

    Also returns what the trial found, for metrics.json: its time [s] and both PSNR [dB]; empty if there was none.

    All ranks of torchrun must call it; rank 0 decides.

    Args:
        config: Config of a new run, with the device chosen.
        capture: Its capture.
        log: Receives what is tried and what follows.
        quiet: Whether to show no progress.
    """
    is_wanted = _is_wanted(config, capture)
    config = dataclasses.replace(config, assume=config.assumption)
    if not is_wanted:
        return config, {}
    start, small = time.perf_counter(), reduced_capture(capture, MAX_SIDE)
    length, of_run = TRIAL.schedule.num_iterations, config.schedule.num_iterations
    log(f"the masks are estimates: two trainings of {length} iterations try them out (--assume masks omits them)")
    try:
        log(f"trial 1 of 2 before the {of_run} iterations of the run, with the masks:")
        following = held_out_psnr(config, small, "masks", quiet)
        log("trial 2 of 2, without the masks:")
        ignoring = held_out_psnr(config, small, "dynamic", quiet)
    except (ValueError, OSError) as error:
        if ranks.num_ranks() > 1:
            raise  # the others would wait for this one
        log(f"the masks are used, because they could not be tried out: {one_line(error)}")
        return config, {}
    trial = {"mask_trial_psnr_with": following, "mask_trial_psnr_without": ignoring}
    trial["mask_trial_seconds"] = time.perf_counter() - start
    found = f"frames held out of the trial have {following:.1f} dB with the masks and {ignoring:.1f} dB without"
    if not ranks.text_of_first("worse" if ignoring > following else ""):
        log(f"{found}: the masks are used")
        return config, trial
    log(f"{found}: the masks are not used, everything is dynamic (--assume masks uses them all the same)")
    return dataclasses.replace(config, assume="dynamic"), trial


def _is_wanted(config: TrainConfig, capture: Capture) -> bool:
    """Whether there are estimated masks to try out, and the run is much longer than the trial."""
    is_long = config.schedule.num_iterations >= MIN_RELATIVE_LENGTH * TRIAL.schedule.num_iterations
    is_asked = config.assume == "auto" and capture.assuming("masks").uses_estimated_masks
    return is_asked and is_long and len(capture.train) >= MIN_FRAMES


def held_out_psnr(config: TrainConfig, capture: Capture, assume: Assumption, quiet: bool = True) -> float:
    """PSNR of held-out training frames after a short training, mean [dB].

    Args:
        config: Config of the run, with the device chosen; the trial has its switches.
        capture: Its capture.
        assume: What is taken as dynamic.
        quiet: Whether to show no progress.

    Raises:
        KeyboardInterrupt: After Ctrl-C or SIGTERM.
        ValueError: If the loss is repeatedly not finite.
        OSError: If a temporary file cannot be written.
    """
    parts = {name: getattr(TRIAL, name) for name in ("model", "loss", "optim", "densify", "schedule")}
    # Held-out frames keep their exposure, so those that train must do so, too.
    config = dataclasses.replace(config, **parts, iterations=None, exposure=False, assume=assume)
    held_out = capture.train[HELD_OUT // 2 :: HELD_OUT]
    capture = capture.split([name for name in capture.train if name not in held_out], held_out)
    values: list[float] = []

    def compare(progress: Progress) -> None:  # once training is done
        if progress.status.iteration == progress.num_iterations:
            values.extend(render_and_compare(progress.scene, progress.capture.frame(name))[1] for name in held_out)

    with tempfile.TemporaryDirectory(prefix="warpgs-trial-") as folder, Interrupt() as interrupt:
        trainer = Trainer(prepare_start(config, capture), Path(folder))
        trainer.callbacks = [compare]
        with TrainingLogger(None, trainer.protocol.num_iterations, 0, quiet, trainer.protocol.remaining_cost) as logger:
            finished = trainer.train(logger, interrupt)
    trainer.step.release_graphs()
    if not finished:
        raise KeyboardInterrupt("stopped while the masks were tried out; no run has begun: give the same command again")
    return sum(values) / len(values)
