"""A run's scene, moment by moment, as clouds."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from warpgs.cameras import Camera
from warpgs.config import RenderSettings, TrainConfig
from warpgs.model.scene import SplitScene
from warpgs.progress import progress
from warpgs.render import render
from warpgs.runs import run as runs
from warpgs.runs.trained import Player

from .cloud import Cloud


@dataclass(frozen=True)
class Moments:
    """A scene as the stage that it was trained to shows it.

    Attributes:
        scene: The Gaussians and networks.
        config: Of the run.
        facts: What the checkpoint says of itself.
        rows: Which Gaussians to show, static ones first; all if None.
    """

    scene: SplitScene
    config: TrainConfig
    facts: dict[str, Any]
    rows: Int64[np.ndarray, " M"] | None = None

    @staticmethod
    def of_run(folder: Path, data: Path | None = None) -> "Moments":
        """The newest checkpoint of a run, on the CPU.

        Args:
            folder: Of the run.
            data: Where its capture is now, if it was moved.

        Raises:
            ValueError: If the folder is no run, has no checkpoint, or is damaged.
        """
        config = runs.load_config(folder)
        config = dataclasses.replace(config, device="cpu", data=data or config.data)
        scene, facts = runs.newest_scene(folder, config)
        return Moments(scene, config, facts)

    def at(self, time: float) -> Cloud:
        """The Gaussians at a moment in [0, 1], in the same rows at every moment."""
        cloud = Cloud.of_splats(Player(self.scene, self.config, self.facts).splats(time))
        return cloud if self.rows is None else cloud.select(self.rows)

    def lightest_left_out(self, most: int, cameras: Sequence[Camera], quiet: bool = True) -> "Moments":
        """The same scene with at most so many Gaussians: those that some camera sees most of.

        Raises:
            ValueError: If ``most`` is not positive.
        """
        if most < 1:
            raise ValueError(f"--max-gaussians must be at least 1, got {most}")
        settings = RenderSettings(statistics=True, antialias=self.config.antialias)
        weight = np.zeros(len(self.at(0.0)))
        if len(weight) <= most:
            return self
        for camera in progress(cameras, "weighing Gaussians", quiet):
            weights = render(self.at(camera.time).splats(), camera, settings=settings).weights
            assert weights is not None
            weight = np.maximum(weight, weights.numpy())
        kept = np.sort(np.argsort(-weight, kind="stable")[:most])
        return dataclasses.replace(self, rows=kept if self.rows is None else self.rows[kept])
