"""Options of ``warpgs render``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.command_line.parsing import RunFolder, parse_size
from warpgs.editing.options import Editing
from warpgs.errors import require_present

PathName = Literal["views", "fixed", "frozen", "moving", "spiral", "bullet"]


@dataclass(frozen=True)
class Render:
    """Renders a run's newest checkpoint to images and a video."""

    run_folder: RunFolder
    """Run folder; or a file of Gaussians of another program (.ply, .sog, .spz, .glb, .splat), or a folder of such files
    over time."""
    path: PathName | None = None
    """Camera path: the evaluation views (default); a fixed camera over time; the training camera's path at one fixed
    time; the same path over time; a spiral around the middle view (default of files); bullet time, which stops on the
    same path."""
    keyframes: Path | None = None
    """JSON file of keyframes to follow instead (docs/viewing.md)."""
    cameras: Path | None = None
    """Film at exactly the cameras of a transforms.json or of the folder of a COLMAP model instead, in the coordinates
    of the scene; or of a USD file (.usd, .usda, .usdc, .usdz), in those of exported files."""
    out: Path | None = None
    """Output folder; RUN/render/PATH by default."""
    view: str | None = None
    """Id of the start view of fixed, spiral and bullet; by default the middle evaluation view. Without it, bullet
    follows the training camera, unless that jumps from frame to frame. Of a USD file, the camera."""
    time: float | None = None
    """Time in [0, 1] of frozen and spiral, and at which bullet stops; default 0.5, but all times for spiral."""
    frames: int | None = None
    """Frames along a path; 120 by default."""
    rate: float | None = None
    """Frames per second of the video; 24 by default."""
    write: Literal["both", "png", "mp4", "gif", "webp"] = "both"
    """Numbered PNG files, a video (MP4, GIF or WebP), or both PNG files and MP4."""
    layers: Literal["joint", "static", "dynamic", "all", "depth", "alpha", "objects"] = "joint"
    """What to show: one of the layers, all three side by side, depth in colours (red is near, black is empty), or
    opacity in grey, or objects in colours with the numbers that --objects takes."""
    transparent: bool = False
    """Leave pixels transparent where the layer is; for PNG, GIF and WebP."""
    lens: Literal["pinhole", "recorded"] | None = None
    """Lens of the camera along a path: a pinhole of the same focal length (default), or the one that filmed the start
    view, or the middle evaluation view."""
    truth: bool = False
    """For views: show the ground truth beside the rendered image."""
    scale: float = 1.0
    """Image size as a factor of the capture's."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WIDTHxHEIGHT")] = None
    """Image size instead, such as 1080x1920; the view is cropped to it, not stretched [px]."""
    supersample: int = 1
    """Render at this multiple of the size, then average down."""
    editing: Annotated[Editing, tyro.conf.arg(name="")] = field(default_factory=Editing)
    data: Path | None = None
    """Current folder of the capture, if it was moved."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to render on; CUDA by default if there is a GPU."""
    quiet: bool = False
    """Hide progress."""

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of ``size`` [px].

        Raises:
            ValueError: If it does not have the form WIDTHxHEIGHT, or is out of range.
        """
        return parse_size("--size", self.size or "")

    @property
    def path_name(self) -> str:
        """The path, or "keyframes" or "cameras"."""
        if self.cameras is not None:
            return "cameras"
        return "keyframes" if self.keyframes is not None else self.path or "views"

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such run."""
        require_present(self.run_folder)
