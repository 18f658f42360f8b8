"""A trained scene as a cloud of Gaussians at any time."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.rendering import render
from warpgs.runs.trained import TrainedScene

from .cloud import Cloud


@dataclass(frozen=True)
class Clouds:
    """The clouds of a trained scene over time.

    Attributes:
        scene: The scene, on the CPU.
        rows: Indices of the Gaussians to export, static ones first; all if None.
        weights: Their ``visibility``, if it is known.
    """

    scene: TrainedScene
    rows: Int64[np.ndarray, " M"] | None = None
    weights: Float32[np.ndarray, " M"] | None = None

    def __len__(self) -> int:
        scene = self.scene.scene
        return len(scene.static) + len(scene.dynamic) if self.rows is None else len(self.rows)

    def at(self, time: float) -> Cloud:
        """The Gaussians at a time in [0, 1], in the same rows at every time."""
        cloud = Cloud.of_splats(self.scene.splats(time), self.scene.config.antialias)
        return cloud if self.rows is None else cloud.select(self.rows)

    def visibility(self, cameras: Sequence[Camera], quiet: bool = True) -> Float32[np.ndarray, " N"]:
        """Each Gaussian's sum of blend weights in the image [px], the maximum over cameras, each at its own time."""
        if self.weights is not None:
            return self.weights
        settings = dataclasses.replace(self.scene.config.render_settings, statistics=True)
        largest = np.zeros(len(self), np.float32)
        for camera in progress(cameras, "measuring visibility", quiet):
            weights = render(self.at(camera.time).splats(), camera, settings=settings).weights
            assert weights is not None
            largest = np.maximum(largest, weights.numpy())
        return largest

    def most_visible(self, count: int, cameras: Sequence[Camera], quiet: bool = True) -> "Clouds":
        """The same scene with at most ``count`` Gaussians: those of maximum ``visibility``.

        Args:
            count: Maximum number of Gaussians, at least 1.
            cameras: Cameras to measure blend weights with, each at its own time.
            quiet: Whether to hide the progress bar.

        Raises:
            ValueError: If ``count`` is not positive.
        """
        if count < 1:
            raise ValueError(f"expected at least 1 Gaussian to keep, got {count}")
        if len(self) <= count:
            return self
        weights = self.visibility(cameras, quiet)
        kept = np.sort(np.argsort(-weights, kind="stable")[:count])
        rows = kept if self.rows is None else self.rows[kept]
        return dataclasses.replace(self, rows=rows, weights=weights[kept])
