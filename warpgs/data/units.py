"""Scene units: positions of the files, shifted and scaled to about [-1, 1]."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from warpgs.files import MAX_NUMBER, read_json, read_numbers

MIN_SCALE = 1e-9
"""Minimum number of scene units per unit of the files; the maximum is ``files.MAX_NUMBER``."""


MIN_SIZE = 1e-9
"""Minimum size of a scene, which a scale divides by [world units]."""


@dataclass(frozen=True)
class SceneUnits:
    """The transform (p − center) · scale from positions of the files (world units) to the scene.

    Attributes:
        center: [3] centre of the scene [world units].
        scale: Scene units per world unit.
    """

    center: Float[np.ndarray, "3"]
    scale: float

    def from_world(self, positions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Positions in scene units of positions in world units.

        Raises:
            ValueError: If one is not finite or larger than ``files.MAX_NUMBER``.
        """
        scene = (positions - self.center) * self.scale
        if not (np.abs(scene) <= MAX_NUMBER).all():
            raise ValueError(f"positions must be finite and at most {MAX_NUMBER:g} scene units from the center")
        return scene


OUTLIER_FRACTION = 0.02
"""Fraction of the points at each end of each axis that does not count for the extent of the scene."""


def scene_units(points: Float[np.ndarray, "P 3"], centers: Float[np.ndarray, "F 3"]) -> SceneUnits:
    """Scene units in which static points and cameras are in about [-1, 1].

    Args:
        points: [P, 3] static points.
        centers: [F, 3] centres of the cameras.
    """
    low, high = np.quantile(points, [OUTLIER_FRACTION, 1 - OUTLIER_FRACTION], axis=0)
    low, high = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
    return SceneUnits((low + high) / 2.0, float(2.0 / max((high - low).max(), MIN_SIZE)))


def read_units(path: Path) -> SceneUnits:
    """The units in scene.json.

    Raises:
        ValueError: If the file is missing or damaged, or has no valid center and scale.
    """
    fields = read_json(path)
    scale = float(read_numbers(path, fields, "scale", ()))
    if scale < MIN_SCALE:
        raise ValueError(f"{path}: scale must be at least {MIN_SCALE}, got {scale}")
    return SceneUnits(read_numbers(path, fields, "center", (3,)), scale)
