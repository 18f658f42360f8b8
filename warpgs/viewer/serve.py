"""``warpgs view``: serves a run to browsers."""

import atexit
import gc
import importlib.util
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress

from warpgs.command_line.version import install_command
from warpgs.editing.options import Editing
from warpgs.errors import one_line
from warpgs.posix import lower_priority
from warpgs.runs import config_file

from .options import View
from .source import POLL_SECONDS, Source, open_source
from .training_cameras import TrainingCameras

NICENESS = 10
"""Niceness of a viewer of a run in training on the CPU: the trainer has priority."""


def serve(options: View, report: Callable[[str], None], warn: Callable[[str], None]) -> None:
    """Serves a run until Ctrl-C.

    Raises:
        ImportError: If viser is not installed.
        ValueError: If the run cannot be shown, or an allowed origin is none.
        OSError: If the server cannot listen on the address.
    """
    if importlib.util.find_spec("viser") is None:
        raise ImportError(f"the viewer needs viser: {install_command('viewer')}")
    from .origin import allowed_origins
    from .server import Viewer, check_address

    allowed = allowed_origins(options.allow_origin)
    if options.while_training and options.editing != Editing():
        raise ValueError("--while-training shows the scene as it is trained, without edits")
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)  # a browser has disconnected
    if options.while_training and not options.run_folder.exists():
        report(f"waiting for a training to create {options.run_folder} (press Ctrl-C to stop)")
        while not (options.run_folder / config_file.NAME).exists():
            time.sleep(POLL_SECONDS)
    source = open_source(options.run_folder, options.device, options.while_training)
    check_address(options.host, options.port)
    if options.while_training and source.device.type == "cpu":
        lower_priority(NICENESS)
    training = training_cameras(source, warn)
    if not options.while_training:
        for note in source.edit(options.editing, None if training is None else training.capture):
            report(note)
    with Viewer(source, training, options.host, options.port, allowed, warn) as viewer:
        host = f"[{options.host}]" if ":" in options.host else options.host
        gc.collect()
        gc.freeze()  # what is there by now stays: collections after visits need not visit it
        report(f"{options.run_folder}: http://{host}:{viewer.port} (press Ctrl-C to stop)")
        _wait()
        report("\nstopping")
        atexit.register(gc.freeze)  # otherwise Python visits all objects at exit: with torch that takes a second


def training_cameras(source: Source, warn: Callable[[str], None]) -> TrainingCameras | None:
    """The training cameras of a run; None, with a warning, if its capture cannot be read."""
    try:
        trained = None if source.follow else source.current()
        clouds = [] if trained is None else [trained.scene.static.means.detach().cpu()]
        return TrainingCameras(source.run.open_corrected_capture(), *clouds)
    except (ValueError, OSError) as error:
        warn(f"without training cameras: {one_line(error)}")
        return None


def _wait() -> None:
    """Waits for Ctrl-C."""
    with suppress(KeyboardInterrupt):
        threading.Event().wait()
