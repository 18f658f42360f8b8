"""Options of ``warpgs check`` and ``warpgs import``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .given import require_given


@dataclass(frozen=True)
class Check:
    """Checks whether a capture is fit to train on; exit code 1 if it is not."""

    capture: Annotated[Path, tyro.conf.arg(metavar="CAPTURE"), tyro.conf.Positional]
    """Folder of the capture, or a built-in one (builtin:studio)."""
    dataset: str | None = None
    """Layout: iphone, nerfds, hypernerf, nerfstudio, blender, dynerf, llff, colmap, vipe or megasam; by default
    recognized from the files."""
    factor: int | None = None
    """Downscaling factor of the images; the dataset's usual one by default."""
    assume: Literal["masks", "static", "dynamic"] = "masks"
    """As in training: take what the masks say, or everything, as static or dynamic."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such capture."""
        require_given(self.capture)


@dataclass(frozen=True)
class Import:
    """Copies a capture of any layout into that of warpgs (docs/capture-format.md), in scene units."""

    source: Annotated[Path, tyro.conf.arg(metavar="SOURCE"), tyro.conf.Positional]
    """Folder of a capture: COLMAP, nerfstudio, D-NeRF, DyNeRF, LLFF, NVIDIA, ViPE, MegaSaM, NeRF-DS, HyperNeRF or
    iPhone."""
    capture: Annotated[Path, tyro.conf.arg(metavar="CAPTURE"), tyro.conf.Positional]
    """Folder to write; it must not exist or be empty."""
    dataset: str | None = None
    """Layout of the source; recognized from its files by default."""
    factor: int | None = None
    """Downscaling factor of the images; that of the layout by default."""
    holdout: int | None = None
    """Keep every N-th frame for evaluation, 0 for none; by default those that the source keeps."""
    holdout_camera: Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID …")] = ()
    """Keep all frames of these cameras for evaluation, and of the others those of --holdout or none."""
    quiet: bool = False
    """Print errors only."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such capture."""
        require_given(self.source)
