"""``warpgs export``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Export:
    """Writes a run's newest checkpoint for other programs: PLY of 3DGS, compressed PLY, or a page that plays it."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folder."""
    format: Literal["ply", "compressed", "html"] = "ply"
    """PLY as 3DGS has it; the compressed PLY of SuperSplat and PlayCanvas; one HTML file that plays offline."""
    out: Path | None = None
    """Folder to write into; RUN/export if left out."""
    time: float | None = None
    """Moment in [0, 1] of a PLY file; 0 if left out."""
    frames: int | None = None
    """Write a PLY file for each of so many moments, evenly spread over [0, 1]."""
    layers: Literal["all", "static", "dynamic", "apart"] = "all"
    """Which Gaussians go into PLY files; apart makes a file of the static and one of the dynamic ones."""
    keys: int | None = None
    """Key times of a page, which mixes between them; 30 if left out."""
    seconds: float | None = None
    """How long a page takes to play the scene; 5 if left out."""
    max_gaussians: int | None = None
    """Keep no more than these, the ones that the filming camera sees most of."""
    max_megabytes: float | None = None
    """Refuse a page whose Gaussians take more than this, before compression [MB]; 256 if left out."""
    data: Path | None = None
    """Where the capture is now, if it was moved; a page begins at its cameras."""
    quiet: bool = False
    """Show no progress."""

    def run(self) -> None:
        """Exports and prints a summary; raises as ``export_run``."""
        from .export_run import export_run

        print(export_run(self))
