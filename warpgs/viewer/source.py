"""Where the scene comes from: the newest checkpoint of a run folder."""

import threading
import time
from pathlib import Path

import torch

from warpgs.errors import one_line
from warpgs.runs.run import Device, Run
from warpgs.runs.trained import TrainedScene

LOOK_EVERY = 2.0
"""Seconds between looks for a newer checkpoint, while somebody watches."""


class Source:
    """The scene of a run, loaded again when there is a newer checkpoint.

    Args:
        run: The run, opened on the device to render on.
        follow: Whether to look for newer checkpoints. Nothing is read then before the first call of ``current`` and
            without calls, so that a viewer without browsers does not slow down training.

    Attributes:
        run: The run.
        note: Why there is no (newer) scene; empty if nothing is wrong.

    Raises:
        ValueError: Without ``follow``, if the run has no checkpoint that can be read.
    """

    def __init__(self, run: Run, follow: bool = False) -> None:
        self.run, self.follow = run, follow
        self.note = ""
        self._lock = threading.Lock()
        self._seen: tuple[Path, int] | None = None
        self._looked = -LOOK_EVERY
        self._scene: TrainedScene | None = None if follow else run.trained_scene()

    @property
    def device(self) -> torch.device:
        return self.run.device

    def current(self) -> TrainedScene | None:
        """The newest scene; the one before it while the newest can't be read, None before the first."""
        with self._lock:
            if self.follow and time.monotonic() - self._looked >= LOOK_EVERY:
                self._looked = time.monotonic()
                self._follow()
            return self._scene

    def _follow(self) -> None:
        try:
            newest = self.run.newest_checkpoint()
            if newest is None:
                self.note = "waiting for the first checkpoint"
                return
            seen = (newest, newest.stat().st_mtime_ns)
            if seen != self._seen:
                self._scene = self.run.trained_scene()
                self._seen, self.note = seen, ""
        except FileNotFoundError:
            return  # the trainer deleted it for a newer one: next time
        except (ValueError, OSError) as error:
            self.note = one_line(error)


def open_source(folder: Path, device: Device | None, follow: bool) -> Source:
    """The source of a run folder.

    Args:
        folder: Run folder.
        device: Device to render on; CUDA if None and there is a GPU.
        follow: Whether to look for newer checkpoints.

    Raises:
        ValueError: If the folder is not a run folder, is damaged, has no checkpoint, or there is no such device.
    """
    return Source(Run.open(folder, device), follow)
