"""``warpgs sweep``."""

from warpgs.command_line.screen import show
from warpgs.errors import terminable

from .options import Sweep
from .run_sweep import run_sweep


def run(options: Sweep) -> int:
    """Trains and prints the tables; returns the exit code; raises as ``run_sweep``."""
    with terminable():
        return run_sweep(options, print if options.dry_run else show)  # a dry run prints a script
