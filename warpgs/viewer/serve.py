"""``warpgs view``: serves a run to browsers."""

import importlib.util
import os
import sys
import threading
import warnings

from warpgs.errors import one_line

from .command import View
from .source import Source, open_source
from .training_cameras import TrainingCameras

NICENESS = 10
"""Of a viewer beside a trainer on the CPU: training has priority."""


def serve(options: View) -> None:
    """Serves a run until Ctrl-C.

    Raises:
        ImportError: If viser is not installed.
        ValueError: If the run cannot be shown.
        OSError: If the address cannot be listened on.
    """
    if importlib.util.find_spec("viser") is None:
        raise ImportError("the viewer needs viser: pip install 'warpgs[viewer]'")
    from .server import Viewer, check_address

    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)  # a browser has left
    check_address(options.host, options.port)
    source = open_source(options.run_folder, options.device, options.while_training)
    if options.while_training and source.device.type == "cpu" and hasattr(os, "nice"):
        os.nice(NICENESS)
    with Viewer(source, training_cameras(source), options.host, options.port) as viewer:
        host = f"[{options.host}]" if ":" in options.host else options.host
        print(f"{options.run_folder}: http://{host}:{viewer.port} (Ctrl-C ends it)", flush=True)
        _wait()


def training_cameras(source: Source) -> TrainingCameras | None:
    """The training cameras of a run; None, and a line that says so, if its capture cannot be read."""
    try:
        return TrainingCameras(source.run.open_capture())
    except (ValueError, OSError) as error:
        print(f"without training cameras: {one_line(error)}", file=sys.stderr)
        return None


def _wait() -> None:
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print()
