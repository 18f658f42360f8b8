"""The ``warpgs`` command."""

import importlib.metadata
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import tyro

from .bench.command import Bench
from .config import TrainConfig
from .errors import is_out_of_memory, one_line, out_of_memory
from .evaluation.command import Eval
from .export.command import Export
from .prepare.command import Check, Prepare
from .report.command import Report
from .training import command as training
from .video.command import Render
from .viewer.command import View


@runtime_checkable
class Command(Protocol):
    """A dataclass of options with a method ``run``."""

    def run(self) -> None:
        """Does what the options ask for."""


COMMANDS: dict[str, Callable[..., Command]] = {
    "bench": Bench,
    "check": Check,
    "eval": Eval,
    "export": Export,
    "prepare": Prepare,
    "render": Render,
    "report": Report,
    "view": View,
}
"""Every command but ``train``, whose defaults depend on its preset."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""

ADVICE = "free some, or ask for less: smaller images, fewer Gaussians; --device cpu where a GPU has too little"
"""What to do without enough memory."""


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
    try:
        command.run()
    except (ValueError, ImportError, OSError) as error:
        print(f"warpgs: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("warpgs: stopped", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        print(f"warpgs: {out_of_memory(error)}; {ADVICE}", file=sys.stderr)
        return 2
    return 0
