"""``warpgs report``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Report:
    """Writes one HTML file about runs that were evaluated: curves, every view's figures, worst and best views, timing.

    The file holds everything that it shows, and loads nothing from anywhere.
    """

    run_folders: Annotated[tuple[Path, ...], tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folders, side by side."""
    out: Path | None = None
    """File to write; report.html if left out, in the run folder if there is only one."""
    views: int = 3
    """Worst and best views to show, so many of each."""
    device: Literal["cuda", "cpu"] | None = None
    """Where to render; CUDA if there is a GPU."""
    quiet: bool = False
    """Show no progress."""

    def run(self) -> None:
        """Writes the report and prints its path; raises as ``write_report``."""
        from .write_report import write_report

        print(write_report(self))
