"""A trained scene as a cloud of Gaussians at any time."""

from dataclasses import dataclass

from warpgs.formats.cloud import Cloud
from warpgs.runs.trained import TrainedScene


@dataclass(frozen=True)
class Clouds:
    """The clouds of a trained scene over time.

    Attributes:
        scene: The scene, on the CPU.
    """

    scene: TrainedScene

    def at(self, time: float) -> Cloud:
        """The Gaussians at a time in [0, 1], in the same rows at every time."""
        return Cloud.of_splats(self.scene.splats(time), self.scene.config.antialias)
