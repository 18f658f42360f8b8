"""``warpgs view``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class View:
    """Shows a run in the browser: move through space and time, see its parts, look through its training cameras."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folder."""
    host: str = "127.0.0.1"
    """Address to listen on: this machine alone can connect, unless you give another (0.0.0.0: everybody can)."""
    port: int = 8080
    """Port to listen on; 0 is any that is free."""
    while_training: bool = False
    """Follow the newest checkpoint of a run that is being trained; reads nothing while no browser is connected."""
    device: Literal["cuda", "cpu"] | None = None
    """Where to render; CUDA if there is a GPU."""

    def run(self) -> None:
        """Serves until Ctrl-C; raises as ``serve``."""
        from .serve import serve

        serve(self)
