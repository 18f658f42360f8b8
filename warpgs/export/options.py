"""Options of ``warpgs export``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.command_line.parsing import RunFolder
from warpgs.editing.options import Editing
from warpgs.errors import require_present


@dataclass(frozen=True)
class Export:
    """Exports the newest checkpoint of a run for other programs, at one time or moving."""

    run_folder: RunFolder
    """Run folder; or a file of Gaussians of another program (.ply, .sog, .spz, .glb, .splat), or a folder of such files
    over time."""
    format: str = "ply"
    """ply: PLY as 3DGS writes it. compressed: compressed PLY of SuperSplat and PlayCanvas. sog: SOG of PlayCanvas.
    spz: SPZ of Niantic, version 4. spz3: SPZ, version 3. glb: binary glTF (KHR_gaussian_splatting). mesh: binary glTF
    of triangles that move, or PLY with --frames. usd: OpenUSD with time samples. 4dgs: container of moving scenes.
    html: one web page that plays the scene offline."""
    out: Path | None = None
    """Output folder, or output file if this ends as files of the format do (scene.ply); RUN/export by default."""
    time: float | None = None
    """Time of a file, in [0, 1]; 0 by default."""
    frames: int | None = None
    """Write this many files, one per time, at times evenly spaced over [0, 1]."""
    layers: Literal["all", "static", "dynamic", "apart"] = "all"
    """Gaussians in files of one time: all, static or dynamic ones, or both apart in two files."""
    up: Literal["capture", "x", "y", "z", "-x", "-y", "-z", "scene"] = "capture"
    """What is up in the files: the capture's upward direction, estimated from its training cameras, or an axis of the
    scene; scene keeps the scene's coordinates, in which the capture's cameras fit."""
    cameras: str | None = None
    """Also write the cameras as training left them, in the coordinates of the file, to the folder cameras: colmap,
    nerfstudio or blender (transforms.json; of D-NeRF), or usd (OpenUSD, moving)."""
    keys: int | None = None
    """Number of key times of html, usd and 4dgs, between which programs interpolate, and of meshes; 30 by default."""
    seconds: float | None = None
    """Duration of the scene in mesh, html, usd and 4dgs, and of --cameras usd [s]; 5 by default."""
    voxel: float | None = None
    """Size of the voxels of a mesh [scene units]; by default as small as a pixel, or larger if there are too many."""
    max_megabytes: float | None = None
    """Refuse to write a page whose Gaussians take more memory than this, before compression [MB]; 256 by default."""
    precision: float | None = None
    """Divide the quantisation steps of a page by this; 1 by default, for about 40 dB against the scene itself."""
    title: str | None = None
    """Title of a page; the name of the run folder by default."""
    url: str | None = None
    """Address of the folder in which a page will be (https://example.org/scenes): where its own address is shared,
    services show its picture then."""
    editing: Annotated[Editing, tyro.conf.arg(name="")] = field(default_factory=Editing)
    data: Path | None = None
    """Current folder of the capture, if it was moved; a page starts at one of its cameras."""
    quiet: bool = False
    """Hide progress bars."""

    def is_out_file(self, suffix: str) -> bool:
        """Whether ``out`` is a file that ends with this suffix, not a folder."""
        return self.out is not None and self.out.suffix.lower() == suffix != "" and not self.out.is_dir()

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such run."""
        require_present(self.run_folder)
