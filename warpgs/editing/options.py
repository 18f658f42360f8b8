"""Options that edit a scene, shared by ``warpgs render``, ``view`` and ``export``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

Box = tuple[float, float, float, float, float, float]
"""Two opposite corners of a box along the axes of the scene: x, y, z and x, y, z [scene units]."""


@dataclass(frozen=True)
class Edits:
    """Which Gaussians to remove, in this order; with the defaults none."""

    crop: Annotated[Box | None, tyro.conf.arg(metavar="X Y Z X Y Z")] = None
    """Remove the Gaussians whose centres are outside of a box at all times, given by two opposite corners in the
    coordinates of the scene."""
    min_opacity: float | None = None
    """Remove the Gaussians whose opacity is lower than this at all times, in [0, 1]."""
    drop_floaters: bool | None = None
    """Remove floaters: isolated Gaussians that the training cameras see little of."""
    max_gaussians: int | None = None
    """Keep at most this many Gaussians: those that the training cameras see most of."""


@dataclass(frozen=True)
class Editing:
    """How to edit a scene: as its file of edits says, with the edits given here in place of those of the same name."""

    given: Annotated[Edits, tyro.conf.arg(name="")] = field(default_factory=Edits)
    edits: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of edits; RUN/edits.json by default, if it exists; none uses no file."""
    save_edits: bool = False
    """Write the edits that are in use to that file, for all later commands. The checkpoint stays as it is."""
