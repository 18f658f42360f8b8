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


DEFAULT_RANGE = (0.01, 10.0)
"""Near and far of a capture without points [scene units]."""

OUTLIER_FRACTION = 0.02
"""Fraction of the points at each end of each axis that does not count for the extent of the scene."""


CAMERA_BOX = 3.0
"""Size of a scene of unknown size, in which training starts from random points, relative to its cameras' box: cameras
look at what is outside of it. The value is that of gsplat (``init_extent``)."""


def scene_units(points: Float[np.ndarray, "P 3"], centers: Float[np.ndarray, "F 3"]) -> SceneUnits:
    """Scene units in which static points and cameras are in about [-1, 1].

    Args:
        points: [P, 3] static points.
        centers: [F, 3] centres of the cameras.
    """
    parts = [OUTLIER_FRACTION, 1 - OUTLIER_FRACTION]
    low, high = np.quantile(points, parts, axis=0)
    if (low == high).all():  # nearly all points are at one place, such as the origin where depth was unknown
        low, high = np.quantile(np.unique(points, axis=0), parts, axis=0)
    low, high = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
    return SceneUnits((low + high) / 2.0, float(2.0 / max((high - low).max(), MIN_SIZE)))


def units_around(centers: Float[np.ndarray, "F 3"]) -> SceneUnits:
    """Scene units of a capture without points, whose scene is ``CAMERA_BOX`` times as large as its cameras' box.

    Args:
        centers: [F, 3] centres of the cameras.
    """
    units = scene_units(centers, centers)
    return SceneUnits(units.center, units.scale / CAMERA_BOX)


def depth_range(depths: Float[np.ndarray, " D"]) -> tuple[float, float]:
    """Near and far for scene.json, which contain nearly all depths with a margin.

    Args:
        depths: [D] depths of points along the cameras' axes [scene units]; those behind a camera do not count.
    """
    depths = depths[depths > 0]
    if len(depths) == 0:
        return DEFAULT_RANGE
    near, far = np.quantile(depths, [0.001, 0.999]).tolist()
    return 0.5 * near, 2.0 * far


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
