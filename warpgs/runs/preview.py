"""The scene of a run in training between its checkpoints, written only while a viewer asks for it."""

import json
import math
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from warpgs.errors import one_line
from warpgs.files import read_json, write_text

from . import checkpoint
from .logger import TrainingLogger
from .progress import Progress
from .trained import TrainedScene

REQUEST, SCENE, STATE = ".preview", "preview.safetensors", "preview.json"
"""Files in a run folder: what a viewer touches, the scene, and the state of the training."""

LAPSE_SECONDS = 10.0
"""A request lapses after this time [s]."""

PREVIEW_SECONDS = 2.0
"""Minimum time between previews [s]."""

PREVIEW_OVERHEAD = 10.0
"""Minimum time between previews, relative to the time that writing one takes."""

MAX_BYTES = 1 << 16
"""Maximum size of the state [bytes]."""


@dataclass(frozen=True)
class State:
    """The state of a training.

    Attributes:
        iteration, num_iterations: Iterations done, and those of the whole run.
        psnr: PSNR of training images [dB].
        rate: Iterations per second; None if unknown.
    """

    iteration: int
    num_iterations: int
    psnr: float
    rate: float | None


def request(folder: Path) -> None:
    """Asks the process that trains in a run folder for its scene; in vain if the folder cannot be written."""
    with suppress(OSError):
        (folder / REQUEST).touch()


def withdraw(folder: Path) -> None:
    """Ends a request."""
    with suppress(OSError):
        (folder / REQUEST).unlink()


def is_requested(folder: Path) -> bool:
    """Whether a viewer has asked for the scene lately."""
    try:
        return time.time() - (folder / REQUEST).stat().st_mtime < LAPSE_SECONDS
    except OSError:
        return False


def write(folder: Path, scene: TrainedScene, state: State) -> None:
    """Writes the scene and the state.

    Raises:
        OSError: If a file cannot be written.
    """
    tensors = {f"scene.{name}": tensor for name, tensor in scene.scene.state_dict().items()}
    checkpoint.save(folder / SCENE, tensors, scene.metadata)
    write_text(folder / STATE, json.dumps(asdict(state)))


def remove(folder: Path) -> None:
    """Removes what ``write`` and ``request`` leave, as far as the disk allows it."""
    withdraw(folder)
    for name in (SCENE, STATE):
        with suppress(OSError):
            (folder / name).unlink()


def read_state(folder: Path) -> State | None:
    """The state of the training; None if there is none, or it is damaged."""
    try:
        values = read_json(folder / STATE, max_bytes=MAX_BYTES)
        iteration, total = int(values["iteration"]), int(values["num_iterations"])
        return State(iteration, total, float(values["psnr"]), values["rate"] and float(values["rate"]))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None


class Previewer:
    """Writes the scene for a viewer of the run folder, while one asks for it; a callback."""

    def __init__(self, folder: Path, logger: TrainingLogger) -> None:
        self._folder, self._logger = folder, logger
        self._next = 0.0
        self._before: tuple[int, float] | None = None

    def __call__(self, progress: Progress) -> None:
        status, now = progress.status, time.monotonic()
        before, self._before = self._before, (status.iteration, now)
        if now < self._next or not is_requested(self._folder):
            return
        iterations, seconds = (status.iteration - before[0], now - before[1]) if before else (0, 0.0)
        rate = iterations / seconds if seconds > 0 else None
        state = State(status.iteration, progress.num_iterations, status.psnr, rate)
        try:
            write(self._folder, progress.scene, state)
        except OSError as error:  # training goes on without
            self._logger.log(f"warning: no previews for the viewer: {one_line(error)}")
            self._next = math.inf
            return
        self._next = now + max(PREVIEW_SECONDS, PREVIEW_OVERHEAD * (time.monotonic() - now))
