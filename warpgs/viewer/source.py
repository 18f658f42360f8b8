"""Where the scene comes from: the newest checkpoint of a run folder."""

import dataclasses
import threading
import time
from pathlib import Path
from typing import Literal

import torch

from warpgs.config import TrainConfig
from warpgs.errors import one_line
from warpgs.runs import checkpoint
from warpgs.runs import run as runs
from warpgs.runs.trained import Player

LOOK_EVERY = 2.0
"""Seconds between looks for a newer checkpoint, while somebody watches."""


class Source:
    """A run's scene, ready to be played.

    Args:
        folder: Run folder.
        config: Its config.
        device: Where the scene goes.
        follow: Whether newer checkpoints are looked for. Nothing is read then before somebody asks, and nothing at all
            while nobody does: a trainer is not slowed by a viewer that nobody looks at.

    Attributes:
        note: Why there is no (newer) scene; empty if nothing is wrong.

    Raises:
        ValueError: Without ``follow``, if the run has no checkpoint that can be read.
    """

    def __init__(self, folder: Path, config: TrainConfig, device: torch.device, follow: bool = False) -> None:
        self.folder, self.config, self.device, self.follow = folder, config, device, follow
        self.note = ""
        self._lock = threading.Lock()
        self._seen: tuple[Path, int] | None = None
        self._looked = -LOOK_EVERY
        self._player: Player | None = None if follow else self._load()

    def current(self) -> Player | None:
        """The newest scene; the one before it while the newest can't be read, None before the first."""
        with self._lock:
            if self.follow and time.monotonic() - self._looked >= LOOK_EVERY:
                self._looked = time.monotonic()
                self._follow()
            return self._player

    def _follow(self) -> None:
        try:
            newest = checkpoint.saved(self.folder)
            if not newest:
                self.note = "waiting for the first checkpoint"
                return
            seen = (newest[-1], newest[-1].stat().st_mtime_ns)
            if seen != self._seen:
                self._player = self._load()
                self._seen, self.note = seen, ""
        except FileNotFoundError:
            return  # the trainer deleted it for a newer one: next time
        except (ValueError, OSError) as error:
            self.note = one_line(error)

    def _load(self) -> Player:
        scene, facts = runs.newest_scene(self.folder, self.config)
        return Player(scene.to(self.device).requires_grad_(False), self.config, facts)


def open_source(folder: Path, device: Literal["cuda", "cpu"] | None, follow: bool) -> Source:
    """The source of a run folder, on the device asked for, else on a GPU if there is one.

    Raises:
        ValueError: If the folder is no run of this version, is damaged or has no checkpoint, or there is no such GPU.
    """
    config = dataclasses.replace(runs.load_config(folder), device=device)
    config = runs.resolve(dataclasses.replace(config, lpips=None))
    return Source(folder, config, torch.device(config.device or "cpu"), follow)
