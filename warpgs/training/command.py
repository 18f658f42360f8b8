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


def parse(arguments: Sequence[str], prog: str = "warpgs train") -> TrainConfig:
    """The config of a command line: a preset's defaults, changed by options.

    The built-in scene has ``quick`` as its default preset, captures have ``paper``.

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

    Ctrl-C saves a checkpoint and ends with 130; wrong options and other errors of the user end with one line and 2.
    """
    try:
        config = parse(sys.argv[1:] if arguments is None else arguments, prog)
        from .train import train  # after --help, which needs no torch

        return train(config)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        print(f"error: {out_of_memory(error)}; {ADVICE}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
