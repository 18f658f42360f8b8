"""Captures as commands are given them: wrong names and paths are refused before anything heavy is imported."""

from pathlib import Path

from warpgs.config.builtin import is_builtin, parse_builtin
from warpgs.data.missing import missing_capture
from warpgs.errors import ending_at_once


def require_given(data: Path | str) -> None:
    """Refuses what means no capture; whether a folder is one, its loader says.

    Raises:
        ValueError: If there is no built-in capture of this name, or no such folder.
    """
    if is_builtin(data):
        parse_builtin(data)
    elif not Path(data).exists():
        raise ValueError(missing_capture(Path(data), _is_capture))


def _is_capture(folder: Path) -> bool:
    with ending_at_once():
        from warpgs.data.loaders import is_capture  # imports torch, which only a folder of a similar name needs

    return is_capture(folder)
