"""Options that edit a scene, shared by ``warpgs render``, ``view`` and ``export``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from .marked import Marked

Box = tuple[float, float, float, float, float, float]
"""Two opposite corners of a box along the axes of the scene: x, y, z and x, y, z [scene units]."""

NamedBox = tuple[str, float, float, float, float, float, float]
"""A name, and a ``Box``."""

NamedColor = tuple[str, float, float, float]
"""An object, and red, green and blue in [0, 1]."""

NamedTime = tuple[str, float]
"""An object, and a time."""


@dataclass(frozen=True)
class Edits:
    """What to change, then which Gaussians to remove, in this order; with the defaults nothing."""

    box: Annotated[tuple[NamedBox, ...], tyro.conf.arg(metavar="NAME X Y Z X Y Z"), tyro.conf.UseAppendAction] = ()
    """Make an object of the static Gaussians whose centres are inside of a box. Dynamic objects are found without it,
    and have the names 1, 2, …; 0 is all that belongs to none."""
    recolor: Annotated[tuple[NamedColor, ...], tyro.conf.arg(metavar="NAME R G B"), tyro.conf.UseAppendAction] = ()
    """Colour an object in shades of red, green and blue in [0, 1]."""
    freeze: Annotated[tuple[NamedTime, ...], tyro.conf.arg(metavar="NAME TIME"), tyro.conf.UseAppendAction] = ()
    """Keep a dynamic object as it is at a time in [0, 1]."""
    shift: Annotated[tuple[NamedTime, ...], tyro.conf.arg(metavar="NAME TIME"), tyro.conf.UseAppendAction] = ()
    """Let a dynamic object move later by a time in [-1, 1]; before its start and after its end it stands still."""
    objects: Annotated[str | None, tyro.conf.arg(metavar="NAME,NAME")] = None
    """Remove all but these objects, such as 2 or 0,1."""
    remove: Annotated[str | None, tyro.conf.arg(metavar="NAME,NAME")] = None
    """Remove these objects."""
    erased: Annotated[Marked | None, tyro.conf.Fixed, tyro.conf.Suppress] = None
    """Remove these Gaussians, which were selected in the viewer."""
    crop: Annotated[Box | None, tyro.conf.arg(metavar="X Y Z X Y Z")] = None
    """Remove the Gaussians whose centres are outside of a box at all times, given by two opposite corners in the
    coordinates of the scene."""
    min_opacity: float | None = None
    """Remove the Gaussians whose opacity is lower than this at all times, in [0, 1]."""
    drop_floaters: bool | None = None
    """Remove floaters: isolated Gaussians that the training cameras see little of."""
    max_gaussians: int | None = None
    """Keep at most this many Gaussians: those that the training cameras see most of."""

    @property
    def about_objects(self) -> bool:
        """Whether they need to know which object a Gaussian belongs to."""
        named = self.objects is not None or self.remove is not None
        return named or any((self.box, self.recolor, self.freeze, self.shift))

    @property
    def by_number(self) -> bool:
        """Whether they name dynamic objects or Gaussians by their numbers, which training changes."""
        named = (name for rows in (self.recolor, self.freeze, self.shift) for name, *_ in rows)
        names = [*map(str, named), *split_names(self.objects), *split_names(self.remove)]
        return self.erased is not None or any(name.isdecimal() and name.strip("0") for name in names)


def split_names(names: str | None) -> list[str]:
    """The names of objects in a list of them; none without a list."""
    return [] if names is None else [name.strip() for name in names.split(",")]


@dataclass(frozen=True)
class Editing:
    """How to edit a scene: as its file of edits says, with the edits given here in place of those of the same name."""

    given: Annotated[Edits, tyro.conf.arg(name="")] = field(default_factory=Edits)
    edits: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of edits; RUN/edits.json by default, if it exists; none uses no file."""
    save_edits: bool = False
    """Write the edits that are in use to that file, for all later commands. The checkpoint stays as it is."""
