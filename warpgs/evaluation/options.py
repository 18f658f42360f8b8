"""Options of ``warpgs eval``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from warpgs.command_line.parsing import RunFolder
from warpgs.config import NetName
from warpgs.errors import require_present


@dataclass(frozen=True)
class Eval:
    """Evaluates a run's newest checkpoint; writes metrics.json, views.csv, images and a video into its folder.

    If training corrected camera poses (preset best), held-out cameras are aligned to the scene by their images first.
    """

    run_folder: RunFolder
    """Run folder."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS; else the one in WARPGS_LPIPS."""
    lpips_net: NetName | None = None
    """Network of LPIPS; by default that of the run's config, vgg unless it was changed."""
    data: Path | None = None
    """Current folder of the capture, if it was moved."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to render on; by default CUDA if there is a GPU."""
    quiet: bool = False
    """Hide progress."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such run."""
        require_present(self.run_folder)
