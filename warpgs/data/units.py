"""Scene units: positions of the files, moved and scaled to about [-1, 1]."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from warpgs.files import read_json


@dataclass(frozen=True)
class SceneUnits:
    """A position p of the files is (p − center) · scale in the scene.

    Attributes:
        center: [3] in the units of the files.
        scale: Scene units in a unit of the files.
    """

    center: Float[np.ndarray, "3"]
    scale: float

    def from_world(self, positions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Positions of the files, in the scene."""
        return (positions - self.center) * self.scale


def read_units(path: Path) -> SceneUnits:
    """The units that scene.json gives.

    Raises:
        ValueError: If the file is missing or damaged, or center or scale are.
    """
    facts = read_json(path)
    try:
        center, scale = np.array(facts["center"], dtype=np.float64), float(facts["scale"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} must have center (3 numbers) and scale (a number)") from error
    if center.shape != (3,) or not np.isfinite(center).all() or not 0.0 < scale < np.inf:
        raise ValueError(f"{path} must have a finite center (3 numbers) and a positive scale")
    return SceneUnits(center, scale)
