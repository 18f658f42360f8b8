"""Options of ``warpgs view``."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from warpgs.command_line.parsing import RunFolder
from warpgs.editing.options import Editing
from warpgs.errors import require_present


@dataclass(frozen=True)
class View:
    """Shows a run in the browser: move through space and time, switch layers, look through the training cameras."""

    run_folder: RunFolder
    """Run folder; or a file of Gaussians of another program (.ply, .sog, .spz, .glb, .splat), or a folder of such files
    over time."""
    host: str = "127.0.0.1"
    """Address to listen on. By default only this machine can connect; 0.0.0.0 accepts connections from everywhere."""
    port: int = 8080
    """Port to listen on; 0 chooses a free one."""
    allow_origin: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="ORIGIN")] = ()
    """Accept connections of the page at this address, such as https://gpu.example.org, where a proxy serves it; may be
    repeated. By default only of the viewer's own page."""
    while_training: bool = False
    """Follow a run in training: show what is trained now. Nothing is read while no browser is connected."""
    editing: Annotated[Editing, tyro.conf.arg(name="")] = field(default_factory=Editing)
    device: Literal["cuda", "cpu"] | None = None
    """Device to render on; CUDA by default if there is a GPU."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such run, unless a training is to make it."""
        if not self.while_training:
            require_present(self.run_folder)
