"""``warpgs render``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

PathName = Literal["views", "fixed", "frozen", "moving", "spiral", "bullet"]


@dataclass(frozen=True)
class Render:
    """Renders a run's newest checkpoint to images and a video."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folder."""
    path: PathName | None = None
    """Camera path: the evaluation views (default); a fixed camera over time; the training camera's path at one fixed
    time; the same path over time; a spiral around the middle view; bullet time around the middle view."""
    keyframes: Path | None = None
    """JSON file of keyframes to follow instead (docs/viewing.md)."""
    out: Path | None = None
    """Output folder; RUN/render/PATH by default."""
    view: str | None = None
    """Id of the start view of fixed, spiral and bullet; the middle evaluation view by default."""
    time: float | None = None
    """Time in [0, 1] of frozen and spiral, and at which bullet stops; default 0.5, but all times for spiral."""
    frames: int | None = None
    """Frames along a path; 120 by default."""
    rate: float | None = None
    """Frames per second of the video; 24 by default."""
    write: Literal["both", "png", "mp4"] = "both"
    """Numbered PNG files, a video, or both."""
    layers: Literal["joint", "static", "dynamic", "all"] = "joint"
    """Layer to show; all shows the three side by side."""
    truth: bool = False
    """For views: show the ground truth beside the rendered image."""
    scale: float = 1.0
    """Image size as a factor of the capture's."""
    supersample: int = 1
    """Render at this multiple of the size, then average down."""
    data: Path | None = None
    """Current folder of the capture, if it was moved."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to render on; CUDA by default if there is a GPU."""
    quiet: bool = False
    """Hide progress."""

    def run(self) -> None:
        """Renders and prints a summary; raises as ``render_run``."""
        from .render_run import render_run

        print(render_run(self))

    @property
    def path_name(self) -> str:
        """The path, or "keyframes"."""
        return "keyframes" if self.keyframes is not None else self.path or "views"
