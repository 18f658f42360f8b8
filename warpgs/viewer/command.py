"""``warpgs view``."""

import importlib.util
import os
import sys
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.errors import one_line
from warpgs.runs import run as runs

from .source import Source, open_source
from .training_cameras import TrainingCameras

NICENESS = 10
"""Of a viewer beside a trainer on the CPU: the trainer goes first."""


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
        """Serves until Ctrl-C.

        Raises:
            ImportError: Without viser.
            ValueError: If the run can't be shown.
            OSError: If the address can't be listened on.
        """
        if importlib.util.find_spec("viser") is None:
            raise ImportError("the viewer needs viser: pip install -e '.[viewer]'")
        from .server import Viewer, check_address

        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)  # a browser left: so what
        check_address(self.host, self.port)
        source = open_source(self.run_folder, self.device, self.while_training)
        if self.while_training and source.device.type == "cpu" and hasattr(os, "nice"):
            os.nice(NICENESS)
        with Viewer(source, training_cameras(source), self.host, self.port) as viewer:
            host = f"[{self.host}]" if ":" in self.host else self.host
            print(f"{self.run_folder}: http://{host}:{viewer.port} (Ctrl-C ends it)", flush=True)
            _wait()


def training_cameras(source: Source) -> TrainingCameras | None:
    """The training cameras of a run; None, and a line that says so, if its capture can't be read."""
    try:
        return TrainingCameras(runs.open_capture(source.config))
    except (ValueError, OSError) as error:
        print(f"without training cameras: {one_line(error)}", file=sys.stderr)
        return None


def _wait() -> None:
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print()
