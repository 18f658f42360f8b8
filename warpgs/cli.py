"""The ``warpgs`` command."""

import sys
from collections.abc import Callable, Sequence

import tyro

from .bench import Bench

COMMANDS: dict[str, Callable[..., Bench]] = {"bench": Bench}
"""Each command is a dataclass of its options with a method ``run``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; wrong options and other errors of the user end with one line and exit code 2."""
    command = tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="warpgs", description=__doc__, args=arguments)
    try:
        command.run()
    except (ValueError, ImportError, OSError) as error:
        print(f"warpgs: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0
