"""The ``warpgs`` command."""

import importlib.metadata
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import tyro

from .bench.command import Bench
from .config import TrainConfig
from .data.command import Check, Import
from .errors import run_command
from .evaluation.command import Eval
from .export.command import Export
from .prepare.command import Prepare
from .report.command import Report
from .sweep.command import Sweep
from .training import command as training
from .video.command import Render
from .viewer.command import View


@runtime_checkable
class Command(Protocol):
    """A dataclass of options with a method ``run``."""

    def run(self) -> object:
        """Does what the options ask for; returns the exit code if that is not 0."""


COMMANDS: dict[str, Callable[..., Command]] = {
    "bench": Bench,
    "check": Check,
    "eval": Eval,
    "export": Export,
    "import": Import,
    "prepare": Prepare,
    "render": Render,
    "report": Report,
    "sweep": Sweep,
    "view": View,
}
"""Every command but ``train``, whose defaults depend on its preset."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; wrong options and other errors of the user end with one line and exit code 2."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        print(f"warpgs {importlib.metadata.version('warpgs')}")
        return 0
    if arguments[:1] == ["train"]:
        return training.main(arguments[1:], "warpgs train")
    commands: dict[str, Callable[..., Any]] = {**COMMANDS, "train": TrainConfig}
    command: Command = tyro.extras.subcommand_cli_from_dict(
        commands, prog="warpgs", description=__doc__, args=arguments
    )
    return run_command(command.run)
