"""python train.py [--data CAPTURE] [--preset paper|fast|quick]: trains SplitGaussian on a capture."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence

import tyro

from warpgs.config import PRESETS, TrainConfig, scaled
from warpgs.data.capture import Capture
from warpgs.data.check import quick_findings
from warpgs.errors import is_out_of_memory, one_line, out_of_memory
from warpgs.runs import run as runs
from warpgs.training.interrupt import Interrupt
from warpgs.training.logger import TrainingLogger
from warpgs.training.trainer import Trainer

NO_DEPTH = ": training without depth, and without the pretraining that needs it"


def parse(arguments: Sequence[str]) -> TrainConfig:
    """The config of a command line: a preset's defaults, changed by options.

    The built-in scene has ``quick`` as its default preset, captures have ``paper``.

    Raises:
        ValueError: If a run is to be resumed with options of its own.
    """
    options = {argument.split("=")[0].replace("_", "-") for argument in arguments if argument.startswith("--")}
    if "--resume" in options and (others := sorted(options - {"--resume", "--device", "--help"})):
        raise ValueError(f"--resume takes everything but --device from the run's config.json: leave out {others[0]}")
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", choices=list(PRESETS))
    first.add_argument("--data")
    known, _ = first.parse_known_args(list(arguments))
    preset = known.preset or ("paper" if known.data else "quick")
    return tyro.cli(TrainConfig, default=PRESETS[preset], args=list(arguments), prog="train.py")


def checked(capture: Capture, config: TrainConfig) -> Capture:
    """The capture, after its warnings; one that would be trained on in vain ends the program with exit code 1."""
    findings = quick_findings(capture, all_static=config.assume == "static")
    for finding in findings:
        print(finding, file=sys.stderr if finding.level == "error" else sys.stdout)
    if any(finding.level == "error" for finding in findings):
        raise SystemExit(1)
    return capture


def start(config: TrainConfig) -> Trainer:
    """A trainer at the start of a new run, or where an earlier run stopped."""
    if config.resume is None:
        config = scaled(runs.resolve(config))
        capture = checked(runs.open_capture(config), config)
        trainer = Trainer(config, capture, runs.new_folder(config, capture))
        runs.create(trainer.run, config)  # now that nothing has been refused
        return trainer
    folder, device = config.resume, config.device
    config = runs.load_config(folder)
    config = runs.resolve(dataclasses.replace(config, device=device or config.device))
    trainer = Trainer(config, checked(runs.open_capture(config), config), folder)
    trainer.restore_newest()
    return trainer


def main(config: TrainConfig) -> int:
    """Trains, then evaluates; Ctrl-C keeps what was done."""
    trainer = start(config)
    folder = trainer.run
    views, aligned = len(trainer.views), trainer.num_aligned
    print(f"{trainer.capture.name}: {views} views, on {trainer.config.device}, into {folder}")
    if aligned < views:
        print(
            f"depth can be aligned with the sparse points in {aligned} of {views} views" + ("" if aligned else NO_DEPTH)
        )
    steps = trainer.protocol.num_iterations
    with (
        runs.held(folder),
        Interrupt() as interrupt,
        TrainingLogger(folder / "events", steps, trainer.iteration) as logger,
    ):
        finished = trainer.train(logger, interrupt)
    if not finished:
        print(f"stopped after iteration {trainer.iteration} of {steps}; go on with --resume {folder}", file=sys.stderr)
        return 130
    print(runs.evaluate_run(folder, trainer.capture, device=trainer.config.device))
    print(f"metrics.json, views.csv, pictures/ and time.mp4 are in {folder}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(parse(sys.argv[1:])))
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        advice = (
            "the run's last checkpoint is whole; start a new run with a smaller --densify.max-gaussians or a larger"
        )
        print(f"error: {out_of_memory(error)}; {advice} --factor", file=sys.stderr)
        sys.exit(2)
    except (ValueError, OSError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(130)
