"""Where the scene comes from: the newest checkpoint of a run folder."""

import dataclasses
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from warpgs import checkpoint, runs
from warpgs.config import TrainConfig
from warpgs.scene.splats import Splats
from warpgs.scene.split import SplitScene

LOOK_EVERY = 2.0
"""Seconds between looks for a newer checkpoint, while somebody watches."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A scene as a checkpoint has it.

    Attributes:
        iteration: Iterations it was trained for.
        moving, relit: Which of the networks its stage uses.
        sh_degree: Highest degree of spherical harmonics in use.
        antialias: As trained with.
    """

    scene: SplitScene
    iteration: int
    moving: bool
    relit: bool
    sh_degree: int
    antialias: bool

    @torch.no_grad()
    def splats(self, moment: float, residual: bool) -> Splats:
        """The scene at a moment, with or without the appearance residual."""
        when = torch.tensor([moment], device=self.scene.static.means.device)
        return self.scene.splats(when, self.moving, self.relit and residual, self.sh_degree)

    @property
    def center(self) -> torch.Tensor:
        """Median of the Gaussians' centres, on the CPU; zero without Gaussians."""
        means = torch.cat([self.scene.static.means, self.scene.dynamic.means]).detach().cpu()
        return means.median(0).values if len(means) else torch.zeros(3)


class Source:
    """Snapshots of a run.

    Args:
        folder: Run folder.
        config: Its config.
        device: Where the scene goes.
        follow: Whether newer checkpoints are looked for. Nothing is read then before somebody asks, and nothing at all
            while nobody does: a trainer is not slowed by a viewer that nobody looks at.

    Attributes:
        note: Why there is no (newer) snapshot; empty if nothing is wrong.

    Raises:
        ValueError: Without ``follow``, if the run has no checkpoint that can be read.
    """

    def __init__(self, folder: Path, config: TrainConfig, device: torch.device, follow: bool = False) -> None:
        self.folder, self.config, self.device, self.follow = folder, config, device, follow
        self.note = ""
        self._lock = threading.Lock()
        self._seen: tuple[Path, int] | None = None
        self._looked = -LOOK_EVERY
        self._snapshot: Snapshot | None = None if follow else self._load()

    def current(self) -> Snapshot | None:
        """The newest snapshot; the one before it while the newest can't be read, None before the first."""
        with self._lock:
            if self.follow and time.monotonic() - self._looked >= LOOK_EVERY:
                self._looked = time.monotonic()
                self._follow()
            return self._snapshot

    def _follow(self) -> None:
        try:
            newest = checkpoint.saved(self.folder)
            if not newest:
                self.note = "waiting for the first checkpoint"
                return
            seen = (newest[-1], newest[-1].stat().st_mtime_ns)
            if seen != self._seen:
                self._snapshot = self._load()
                self._seen, self.note = seen, ""
        except FileNotFoundError:
            return  # the trainer deleted it for a newer one: next time
        except (ValueError, OSError) as error:
            self.note = " ".join(str(error).split())

    def _load(self) -> Snapshot:
        scene, facts = runs.newest_scene(self.folder, self.config)
        return Snapshot(
            scene.to(self.device).requires_grad_(False),
            int(facts["iteration"]),
            bool(facts["moving"]),
            bool(facts["relit"]),
            int(facts["sh_degree"]),
            self.config.antialias,
        )


def open_source(folder: Path, device: Literal["cuda", "cpu"] | None, follow: bool) -> Source:
    """The source of a run folder, on the device asked for, else on a GPU if there is one.

    Raises:
        ValueError: If the folder is no run of this version, is damaged or has no checkpoint, or there is no such GPU.
    """
    config = dataclasses.replace(runs.load_config(folder), device=device)
    config = runs.resolve(dataclasses.replace(config, lpips=None))
    return Source(folder, config, torch.device(config.device or "cpu"), follow)
