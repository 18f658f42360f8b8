"""Captures that the package renders itself, by name: ``--data builtin:studio?depth=network``."""

from pathlib import Path
from typing import Any

PREFIX = "builtin:"

NAMES = ("builtin:room", "builtin:balls", "builtin:studio", "builtin:studio?depth=exact", "…=network", "…=none")
DEPTHS = ("exact", "network", "none")


def is_builtin(data: Path | str) -> bool:
    """Whether this is the name of a built-in capture, not a folder."""
    return str(data).startswith(PREFIX)


def builtin_folder(data: Path | str, quiet: bool = False) -> Path:
    """The folder of a built-in capture, which is created on the first call.

    Args:
        data: Its name.
        quiet: Whether to hide the progress bar.

    Raises:
        ValueError: If there is no such capture.
        OSError: If it cannot be written.
    """
    name, _, query = str(data).removeprefix(PREFIX).partition("?")
    depth: Any = query.removeprefix("depth=") if query else "exact"
    if name == "room" and not query:
        from .synthetic import builtin_capture  # imports torch

        return builtin_capture(quiet=quiet)
    if name == "balls" and not query:
        from .balls import balls_capture

        return balls_capture(quiet=quiet)
    if name == "studio" and depth in DEPTHS and query in ("", f"depth={depth}"):
        from .studio import studio_capture

        return studio_capture(depth, quiet=quiet)
    raise ValueError(f"there is no built-in capture {data}, expected one of {', '.join(NAMES)}")
