"""``warpgs report``."""

from warpgs.command_line.screen import show

from .options import Report
from .write_report import write_report


def run(options: Report) -> None:
    """Writes the report and prints a summary; raises as ``write_report``."""
    show(write_report(options))
