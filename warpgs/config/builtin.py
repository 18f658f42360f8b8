"""Names of the captures that the package renders itself: ``--data 'builtin:studio?depth=network&frames=12'``."""

from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from warpgs.errors import suggestion

PREFIX = "builtin:"

DEPTHS, TRACKS, SKY = ("exact", "network", "none"), ("none", "exact", "broken"), ("no", "yes")
MIN_FRAMES, MAX_FRAMES = 2, 160
"""Number of training frames of ``builtin:studio?frames=N``; as many are the default."""

RIG_FRAMES, MAX_CAMERAS, MAX_OFFSET = 60, 5, 1.0
"""Frames of each camera of ``builtin:rig?frames=N``, training cameras of ``builtin:rig?cameras=N``, and maximum of
``builtin:rig?offset=S``, by which the clocks of its cameras differ at most [s]; the first two are the defaults."""

QUERIES = {"studio": ("depth", "frames", "tracks", "sky"), "rig": ("frames", "cameras", "offset")}
"""What may follow the names of built-in captures."""

NAMES = (
    *("builtin:room", "builtin:balls", "builtin:rig", "builtin:studio"),
    *(f"builtin:studio?depth={depth}" for depth in DEPTHS),
    *(f"builtin:studio?tracks={tracks}" for tracks in TRACKS[1:]),
    "builtin:studio?sky=yes",
)


def is_builtin(data: Path | str) -> bool:
    """Whether this is the name of a built-in capture, not a folder."""
    return str(data).startswith(PREFIX)


class Builtin(NamedTuple):
    """A built-in capture.

    Attributes:
        name: "room", "balls", "studio" or "rig".
        depth: Depth of the studio.
        num_frames: Number of training frames of the studio, and frames of each camera of the rig.
        num_cameras: Number of training cameras of the rig.
        offset: By how much the clocks of its cameras differ at most [s].
        tracks: Tracks of the studio.
        sky: Whether the studio is open, without tracks.
    """

    name: str
    depth: Literal["exact", "network", "none"] = "exact"
    num_frames: int = MAX_FRAMES
    num_cameras: int = MAX_CAMERAS
    offset: float = 0.0
    tracks: Literal["none", "exact", "broken"] = "none"
    sky: bool = False


def parse_builtin(data: Path | str) -> Builtin:
    """The built-in capture that a name means.

    Raises:
        ValueError: If there is no such capture.
    """
    given = str(data).removeprefix(PREFIX)
    name, mark, query = given.partition("?")
    options = dict(part.partition("=")[::2] for part in query.split("&")) if mark else {}
    is_known = f"{PREFIX}{name}" in NAMES and {*options} <= {*QUERIES.get(name, ())} and bool(options) == bool(mark)
    is_known &= options.get("depth", "exact") in DEPTHS and options.get("tracks", "none") in TRACKS
    sky = options.get("sky", "no")
    is_known &= sky in SKY and (sky == "no" or options.get("tracks", "none") == "none")
    if not is_known:
        # Without the prefix, which would make all names similar.
        close = suggestion(given, [name.removeprefix(PREFIX) for name in NAMES], f"{PREFIX}{{}}".format)
        parts = {f"{PREFIX}{of}": f" (?{'=, '.join(queries)}=)" for of, queries in QUERIES.items()}
        known = [f"{name}{parts.get(name, '')}" for name in NAMES if "?" not in name]
        expected = f"expected one of {', '.join(known)}, joined by &"
        raise ValueError(f"there is no built-in capture {data}, {expected}{close}")
    most = RIG_FRAMES if name == "rig" else MAX_FRAMES
    return Builtin(
        name,
        cast(Any, options.get("depth", "exact")),
        _whole(data, options.get("frames", str(most)), MIN_FRAMES, most, "frames"),
        _whole(data, options.get("cameras", str(MAX_CAMERAS)), 1, MAX_CAMERAS, "cameras"),
        _seconds(data, options.get("offset", "0")),
        cast(Any, options.get("tracks", "none")),
        sky == "yes",
    )


def _whole(data: Path | str, text: str, low: int, high: int, unit: str) -> int:
    if not text.isdecimal() or not low <= int(text) <= high:
        raise ValueError(f"{data}: expected {low} to {high} {unit}, got {text}")
    return int(text)


def _seconds(data: Path | str, text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0.0 <= seconds <= MAX_OFFSET:
        raise ValueError(f"{data}: expected an offset from 0 to {MAX_OFFSET:g} seconds, got {text}")
    return seconds


def require_factor(data: Path | str, factor: int | None) -> None:
    """Raises ValueError if a downscaling factor is wanted that built-in captures lack."""
    if factor not in (None, 1):
        raise ValueError(f"{data} has images of one size: omit --factor {factor}")
