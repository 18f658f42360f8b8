"""``warpgs train`` and ``python train.py``."""

import argparse
from collections.abc import Sequence

import tyro

from warpgs.captures.findings import UnfitCaptureError
from warpgs.captures.given import require_given
from warpgs.command_line.parsing import ALWAYS, flags, one_line_errors
from warpgs.command_line.screen import show, show_error
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS
from warpgs.errors import ending_at_once, require_present, run_command, suggestion

ADVICE = (
    "the run's last checkpoint is complete; start a new run with a smaller --densify.max-gaussians or a larger --factor"
)

RESUMING = {"--resume", "--data", "--device", "--iterations", "--lpips", "--lpips-net", "--help"}
"""Options that can be given with ``--resume``."""

UNFIT = 1
"""Exit code if training on the capture would be useless."""


def parse(arguments: Sequence[str], prog: str = "warpgs train") -> TrainConfig:
    """The config of a command line: the defaults of a preset, changed by options.

    The default preset is ``quick`` for the built-in scene and ``best`` for captures.

    Raises:
        ValueError: If a run is resumed with other options, or a capture or its layout is given in a wrong way.
    """
    options = {argument.split("=")[0].replace("_", "-") for argument in arguments if argument.startswith("--")}
    if "--resume" in options and (others := sorted(options - RESUMING)):
        raise ValueError(
            "--resume takes all but --data, --device, --iterations and --lpips from the run's config.json: "
            f"omit {others[0]}"
        )
    if {"--resume", "--lpips-net"} <= options and "--lpips" not in options:
        raise ValueError("--lpips-net with --resume needs --lpips, the folder of its weights")
    if "--dataset" in options and not options & {"--data", "--help"}:
        raise ValueError("--dataset says how the capture of --data is read: add --data CAPTURE")
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", choices=list(PRESETS))
    first.add_argument("--data")
    known, _ = first.parse_known_args(list(arguments))
    preset = known.preset or ("best" if known.data else "quick")
    default = PRESETS[preset]
    config, unknown = tyro.cli(TrainConfig, default=default, args=list(arguments), prog=prog, return_unknown_args=True)
    if unknown:
        advice = f"; a capture is given by --data {unknown[0]}"
        if unknown[0].startswith("-"):
            advice = suggestion(f"-{unknown[0]}", [*flags(TrainConfig), *ALWAYS])
        raise ValueError(f"unrecognized options: {', '.join(unknown)}{advice}")
    return config


def main(arguments: Sequence[str], prog: str = "train.py") -> int:
    """Trains, then evaluates; returns the exit code.

    Ctrl-C and SIGTERM save a checkpoint and end with 130. Errors that the user can fix end with one line and 2,
    captures on which training would be useless with one line per error and 1.
    """

    def start() -> int:
        with one_line_errors(TrainConfig, arguments, prog, _former):
            config = parse(arguments, prog)
        return run(config)

    return run_command(start, prog, ADVICE)


def _former(name: str) -> str:
    """See ``former_option``."""
    from warpgs.runs.former import former_option  # imports torch, which --help does not need

    return former_option(name)


def run(config: TrainConfig) -> int:
    """Trains, then evaluates, and prints what happens; returns the exit code."""
    if config.resume is not None:
        require_present(config.resume)
    if config.data is not None:
        require_given(config.data)
    with ending_at_once():
        from .train import train  # imports torch, which --help does not need
    try:
        train(config, log=show)
    except UnfitCaptureError as error:
        show_error("\n".join(map(str, error.findings)))
        return UNFIT
    return 0
