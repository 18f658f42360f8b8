"""A training run from start to end: run folder, training, evaluation."""

import dataclasses
import sys

from warpgs.config import TrainConfig, scaled
from warpgs.data.capture import Capture
from warpgs.data.check import quick_findings
from warpgs.evaluation.evaluate_run import evaluate_run
from warpgs.evaluation.lpips import locate
from warpgs.runs.run import Run, choose_device, new_folder, open_capture

from .interrupt import Interrupt
from .logger import TrainingLogger
from .trainer import Trainer

NO_DEPTH = ": training without depth, and without the pretraining that needs it"


def checked(capture: Capture, config: TrainConfig) -> Capture:
    """The capture, after printing its warnings; a capture that is not fit to train on exits with code 1."""
    findings = quick_findings(capture.assuming(config.assume))
    for finding in findings:
        print(finding, file=sys.stderr if finding.level == "error" else sys.stdout)
    if any(finding.level == "error" for finding in findings):
        raise SystemExit(1)
    return capture


def start(config: TrainConfig) -> Trainer:
    """A trainer for a new run, or one that continues ``config.resume`` from its newest checkpoint.

    Raises:
        ValueError: If the run, its capture or an option cannot be used.
        OSError: If the run folder cannot be written.
    """
    if config.resume is None:
        config = scaled(dataclasses.replace(config, device=choose_device(config.device)))
        locate(config.lpips)  # a wrong folder is reported now, not after training
        capture = checked(open_capture(config), config)
        trainer = Trainer(config, capture, new_folder(config, capture))
        Run.create(trainer.run, config)  # now that nothing was refused
        return trainer
    run = Run.open(config.resume, config.device)
    locate(run.config.lpips)
    trainer = Trainer(run.config, checked(run.open_capture(), run.config), run.folder)
    trainer.restore_newest()
    return trainer


def train(config: TrainConfig) -> int:
    """Trains and evaluates; returns the exit code, 130 after Ctrl-C."""
    trainer = start(config)
    run = Run(trainer.run, trainer.config)
    num_views, num_aligned = len(trainer.views), trainer.num_aligned
    print(f"{trainer.capture.name}: {num_views} views, on {trainer.config.device}, into {run.folder}")
    if num_aligned < num_views:
        reason = "" if num_aligned else NO_DEPTH
        print(f"depth can be aligned with the sparse points in {num_aligned} of {num_views} views{reason}")
    steps = trainer.protocol.num_iterations
    with (
        run.lock(),
        Interrupt() as interrupt,
        TrainingLogger(run.folder / "events", steps, trainer.iteration) as logger,
    ):
        finished = trainer.train(logger, interrupt)
    if not finished:
        stopped = f"stopped after iteration {trainer.iteration} of {steps}"
        print(f"{stopped}; continue with --resume {run.folder}", file=sys.stderr)
        return 130
    print(evaluate_run(run.folder, trainer.capture, device=trainer.config.device))
    print(f"metrics.json, views.csv, images/ and time.mp4 are in {run.folder}")
    return 0
