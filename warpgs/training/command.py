"""``warpgs train`` and ``python train.py``."""

import argparse
import sys
from collections.abc import Sequence

import tyro

from warpgs.config import PRESETS, TrainConfig
from warpgs.errors import is_out_of_memory, one_line, out_of_memory

ADVICE = (
    "the run's last checkpoint is complete; start a new run with a smaller --densify.max-gaussians or a larger --factor"
)

UNFIT = 1
"""Exit code if training on the capture would be useless."""

REFUSED = 2
"""Exit code after errors that the user can fix."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def parse(arguments: Sequence[str], prog: str = "warpgs train") -> TrainConfig:
    """The config of a command line: the defaults of a preset, changed by options.

    The default preset is ``quick`` for the built-in scene and ``paper`` for captures.

    Raises:
        ValueError: If a run is resumed with other options.
    """
    options = {argument.split("=")[0].replace("_", "-") for argument in arguments if argument.startswith("--")}
    if "--resume" in options and (others := sorted(options - {"--resume", "--device", "--help"})):
        raise ValueError(f"--resume takes everything but --device from the run's config.json: omit {others[0]}")
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", choices=list(PRESETS))
    first.add_argument("--data")
    known, _ = first.parse_known_args(list(arguments))
    preset = known.preset or ("paper" if known.data else "quick")
    return tyro.cli(TrainConfig, default=PRESETS[preset], args=list(arguments), prog=prog)


def main(arguments: Sequence[str] | None = None, prog: str = "train.py") -> int:
    """Trains, then evaluates; returns the exit code.

    Ctrl-C saves a checkpoint and ends with 130. Errors that the user can fix end with one line and 2, captures on which
    training would be useless with one line per error and 1.
    """
    try:
        return run(parse(sys.argv[1:] if arguments is None else arguments, prog))
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        return _refuse(f"error: {out_of_memory(error)}; {ADVICE}", REFUSED)
    except (ValueError, OSError) as error:
        return _refuse(f"error: {one_line(error)}", REFUSED)
    except KeyboardInterrupt as stop:
        return _refuse(str(stop) or "stopped", INTERRUPTED)


def run(config: TrainConfig) -> int:
    """Trains, then evaluates, and prints what happens; returns the exit code."""
    from .train import UnfitCaptureError, train  # imports torch, which --help does not need

    try:
        train(config, log=print)
    except UnfitCaptureError as error:
        return _refuse("\n".join(map(str, error.findings)), UNFIT)
    return 0


def _refuse(text: str, code: int) -> int:
    print(text, file=sys.stderr)
    return code
