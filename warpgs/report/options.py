"""Options of ``warpgs report``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.errors import require_present


@dataclass(frozen=True)
class Report:
    """Writes one HTML file about evaluated runs: metrics, curves, worst and best views, timing.

    The file contains everything that it shows and loads nothing.
    """

    run_folders: Annotated[tuple[Path, ...], tyro.conf.arg(name="run", metavar="RUN"), tyro.conf.Positional]
    """Run folders, shown side by side."""
    out: Path | None = None
    """Output file; report.html by default, in the run folder if there is only one."""
    views: int = 3
    """Number of worst views and of best views to show."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to render on; CUDA by default if there is a GPU."""
    quiet: bool = False
    """Hide progress bars."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such run."""
        require_present(*self.run_folders)
