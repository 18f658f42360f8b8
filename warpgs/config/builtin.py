"""Names of the captures that the package renders itself: ``--data 'builtin:studio?depth=network&frames=12'``."""

from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from warpgs.errors import suggestion

PREFIX = "builtin:"

DEPTHS = ("exact", "network", "none")
MIN_FRAMES, MAX_FRAMES = 2, 160
"""Number of training frames of ``builtin:studio?frames=N``; as many are the default."""

NAMES = ("builtin:room", "builtin:balls", "builtin:studio", *(f"builtin:studio?depth={depth}" for depth in DEPTHS))


def is_builtin(data: Path | str) -> bool:
    """Whether this is the name of a built-in capture, not a folder."""
    return str(data).startswith(PREFIX)


class Builtin(NamedTuple):
    """A built-in capture.

    Attributes:
        name: "room", "balls" or "studio".
        depth: Depth of the studio.
        num_frames: Number of training frames of the studio.
    """

    name: str
    depth: Literal["exact", "network", "none"] = "exact"
    num_frames: int = MAX_FRAMES


def parse_builtin(data: Path | str) -> Builtin:
    """The built-in capture that a name means.

    Raises:
        ValueError: If there is no such capture.
    """
    given = str(data).removeprefix(PREFIX)
    name, mark, query = given.partition("?")
    options = dict(part.partition("=")[::2] for part in query.split("&")) if mark else {}
    depth, frames = options.pop("depth", "exact"), options.pop("frames", str(MAX_FRAMES))
    is_known = f"{PREFIX}{name}" in NAMES and not options and (name == "studio" or not mark)
    if not is_known or depth not in DEPTHS:
        # Without the prefix, which would make all names similar.
        close = suggestion(given, [name.removeprefix(PREFIX) for name in NAMES], f"{PREFIX}{{}}".format)
        raise ValueError(f"there is no built-in capture {data}, expected one of {', '.join(NAMES)}{close}")
    if not frames.isdecimal() or not MIN_FRAMES <= int(frames) <= MAX_FRAMES:
        raise ValueError(f"{data}: expected {MIN_FRAMES} to {MAX_FRAMES} frames, got {frames}")
    return Builtin(name, cast(Any, depth), int(frames))


def require_factor(data: Path | str, factor: int | None) -> None:
    """Raises ValueError if a downscaling factor is wanted that built-in captures lack."""
    if factor not in (None, 1):
        raise ValueError(f"{data} has images of one size: omit --factor {factor}")
