"""``warpgs export``."""

from warpgs.command_line.screen import show

from .export_run import export_run
from .options import Export


def run(options: Export) -> None:
    """Exports and prints a summary; raises as ``export_run``."""
    show(export_run(options))
