"""Captures that the package renders itself, by name: ``--data builtin:studio?depth=network``."""

from pathlib import Path
from typing import Any

from warpgs.errors import suggestion

PREFIX = "builtin:"

DEPTHS = ("exact", "network", "none")
NAMES = ("builtin:room", "builtin:balls", "builtin:studio", *(f"builtin:studio?depth={depth}" for depth in DEPTHS))


def is_builtin(data: Path | str) -> bool:
    """Whether this is the name of a built-in capture, not a folder."""
    return str(data).startswith(PREFIX)


def parse_builtin(data: Path | str) -> tuple[str, str]:
    """Which built-in capture a name means, without its prefix, and its depth, which only the studio has a choice of.

    Raises:
        ValueError: If there is no such capture.
    """
    given = str(data).removeprefix(PREFIX)
    if str(data) not in NAMES:
        # Without the prefix, which would make all names similar.
        close = suggestion(given, [name.removeprefix(PREFIX) for name in NAMES], f"{PREFIX}{{}}".format)
        raise ValueError(f"there is no built-in capture {data}, expected one of {', '.join(NAMES)}{close}")
    name, _, depth = given.partition("?depth=")
    return name, depth or "exact"


def require_factor(data: Path | str, factor: int | None) -> None:
    """Raises ValueError if a downscaling factor is wanted that built-in captures lack."""
    if factor not in (None, 1):
        raise ValueError(f"{data} has images of one size: omit --factor {factor}")


def builtin_folder(data: Path | str, quiet: bool = False, factor: int | None = None) -> Path:
    """The folder of a built-in capture, which is created on the first call.

    Args:
        data: Its name.
        quiet: Whether to hide that it is made.
        factor: Downscaling factor that is wanted; there is only 1.

    Raises:
        ValueError: If there is no such capture, or it lacks the factor.
        OSError: If it cannot be written.
    """
    depth: Any
    name, depth = parse_builtin(data)
    require_factor(data, factor)
    if name == "room":
        from .synthetic import builtin_capture  # imports torch

        return builtin_capture(quiet=quiet)
    if name == "balls":
        from .balls import balls_capture

        return balls_capture(quiet=quiet)
    from .studio import studio_capture

    return studio_capture(depth, quiet=quiet)
