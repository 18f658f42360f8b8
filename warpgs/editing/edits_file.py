"""The file of edits of a run: a small JSON file next to its checkpoints, which stay as they are."""

import dataclasses
import reprlib
from pathlib import Path
from typing import Any

from warpgs.files import MAX_NUMBER, read_json, read_numbers, write_json

from .options import Box, Editing, Edits

NAME = "edits.json"
"""File in a run folder."""

VERSION = 1
MAX_BYTES = 1 << 16
"""Maximum size of a file [bytes]."""

NONE = Path("none")
"""Instead of a file: no edits but those that are given."""


def edits_in_use(folder: Path, editing: Editing) -> Edits:
    """The edits of a file, each replaced by the one that is given.

    Args:
        folder: Run folder.
        editing: The options.

    Raises:
        ValueError: If an edit that is given or the file is not valid, or a file that is named is missing.
    """
    check(editing.given)
    path = editing.edits or folder / NAME
    if path == NONE or (editing.edits is None and not path.exists()):
        return editing.given
    given = {name: getattr(editing.given, name) for name in _names(editing.given)}
    edits = dataclasses.replace(read_edits(path), **given)
    return dataclasses.replace(edits, drop_floaters=edits.drop_floaters or None)


def save_edits(folder: Path, editing: Editing, edits: Edits) -> Path:
    """Writes edits to the file that the options name, or to the one of the run folder; returns its path.

    Raises:
        ValueError: If the options say that there is no file.
        OSError: If it cannot be written.
    """
    if editing.edits == NONE:
        raise ValueError("--save-edits writes a file: --edits cannot be none")
    path = editing.edits or folder / NAME
    values = {"format": "warpgs edits", "version": VERSION}
    write_json(path, values | {name: getattr(edits, name) for name in _names(edits)})
    return path


def read_edits(path: Path) -> Edits:
    """The edits of a file.

    Raises:
        ValueError: If it is missing, damaged or of another version, or has edits that are unknown or not valid.
    """
    values = read_json(path, max_bytes=MAX_BYTES)
    if values.pop("format", None) != "warpgs edits":
        raise ValueError(f"{path} is not a file of edits of warpgs")
    if (version := values.pop("version", None)) != VERSION:
        raise ValueError(f"{path} has version {reprlib.repr(version)}, this program reads {VERSION}")
    known = [field.name for field in dataclasses.fields(Edits)]
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{path} has an unknown edit {unknown[0][:60]!r}, expected some of {', '.join(known)}")
    parsed = {name: _parsed(path, name, values) for name in values}
    try:
        check(Edits(**parsed))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Edits(**parsed)


def check(edits: Edits) -> None:
    """Raises ValueError if a value is out of its range; the message has the option."""
    if edits.crop is not None:
        if not all(abs(value) <= MAX_NUMBER for value in edits.crop):
            raise ValueError(f"--crop must be six numbers of at most {MAX_NUMBER:g}, got {_listed(edits.crop)}")
        if any(edits.crop[axis] == edits.crop[axis + 3] for axis in range(3)):
            raise ValueError(f"--crop must be opposite corners of a box, got {_listed(edits.crop)}")
    if edits.min_opacity is not None and not 0 <= edits.min_opacity <= 1:
        raise ValueError(f"--min-opacity must be in [0, 1], got {edits.min_opacity}")
    if edits.max_gaussians is not None and edits.max_gaussians < 1:
        raise ValueError(f"--max-gaussians must be at least 1, got {edits.max_gaussians}")


def _names(edits: Edits) -> list[str]:
    """The names of the edits that change something."""
    return [field.name for field in dataclasses.fields(Edits) if getattr(edits, field.name) != field.default]


def _parsed(path: Path, name: str, values: dict[str, Any]) -> Any:
    """The value of an edit in a file."""
    if name == "crop":
        return tuple(read_numbers(path, values, name, (6,)).tolist())
    if name == "min_opacity":
        return float(read_numbers(path, values, name, ()))
    kind, value = bool if name == "drop_floaters" else int, values[name]
    if type(value) is not kind:
        raise ValueError(f"{path}: {name} cannot be {reprlib.repr(value)}")
    return value


def _listed(numbers: Box) -> str:
    return " ".join(f"{number:g}" for number in numbers)
