"""Scene units: positions of the files, shifted and scaled to about [-1, 1]."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from warpgs.files import read_json


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
        """Positions in scene units of positions in world units."""
        return (positions - self.center) * self.scale


def read_units(path: Path) -> SceneUnits:
    """The units in scene.json.

    Raises:
        ValueError: If the file is missing or damaged, or has no valid center and scale.
    """
    fields = read_json(path)
    try:
        center, scale = np.array(fields["center"], dtype=np.float64), float(fields["scale"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} must have center (3 numbers) and scale (a number)") from error
    if center.shape != (3,) or not np.isfinite(center).all() or not 0.0 < scale < np.inf:
        raise ValueError(f"{path} must have a finite center (3 numbers) and a positive scale")
    return SceneUnits(center, scale)
