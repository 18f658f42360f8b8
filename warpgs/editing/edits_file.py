"""The file of edits of a run: a small JSON file next to its checkpoints, which stay as they are."""

import dataclasses
import re
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpgs.files import MAX_NUMBER, read_json, read_numbers, write_json
from warpgs.runs.trained import TrainedScene

from .identity import Identity, identity_of
from .marked import parse_marked
from .options import Editing, Edits, split_names

NAME = "edits.json"
"""File in a run folder."""

VERSION = 1
MAX_BYTES = 64 << 20
"""Maximum size of a file [bytes]."""

ROWS = {"box": 6, "recolor": 3, "freeze": 1, "shift": 1}
"""Edits that are lists of the name of an object and this many numbers."""

BOX_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
"""Names of objects in boxes; the others have numbers."""

NONE = Path("none")
"""Instead of a file: no edits but those that are given."""


def edits_in_use(folder: Path, editing: Editing, scene: TrainedScene) -> Edits:
    """The edits of a file, each replaced by the one that is given.

    Args:
        folder: Run folder.
        editing: The options.
        scene: The scene that is edited, without edits.

    Raises:
        ValueError: If an edit that is given or the file is not valid or would change nothing, a file that is named is
            missing, or it has numbers of objects or Gaussians of another scene.
    """
    check(editing.given)
    path = editing.edits or folder / NAME
    if path == NONE or (editing.edits is None and not path.exists()):
        _check_effect(editing.given, editing.given)
        return editing.given
    given = {name: getattr(editing.given, name) for name in names_of(editing.given)}
    saved, identity = read_edits(path)
    if dataclasses.replace(saved, **{name: getattr(Edits(), name) for name in given}).by_number:
        _check_identity(path, identity, identity_of(scene))
    edits = dataclasses.replace(saved, **given)
    check(edits)
    _check_effect(editing.given, edits)
    return dataclasses.replace(edits, drop_floaters=edits.drop_floaters or None)


def save_edits(folder: Path, editing: Editing, edits: Edits, scene: TrainedScene) -> Path:
    """Writes edits to the file that the options name, or to the one of the run folder; returns its path.

    The file says which scene it is for if it has numbers of objects or Gaussians.

    Raises:
        ValueError: If the options say that there is no file.
        OSError: If it cannot be written.
    """
    if editing.edits == NONE:
        raise ValueError("--save-edits writes a file: --edits cannot be none")
    path = editing.edits or folder / NAME
    values: dict[str, Any] = {"format": "warpgs edits", "version": VERSION}
    if edits.by_number:
        values["checkpoint"] = identity_of(scene)._asdict()
    values |= {name: getattr(edits, name) for name in names_of(edits)}
    if edits.erased is not None:
        values["erased"] = edits.erased.for_json()
    write_json(path, values)
    return path


def read_edits(path: Path) -> tuple[Edits, Identity | None]:
    """The edits of a file and the scene that they are for; None if the file does not say it.

    Raises:
        ValueError: If it is missing, damaged or of another version, or has edits that are unknown or not valid.
    """
    values = read_json(path, max_bytes=MAX_BYTES)
    if values.pop("format", None) != "warpgs edits":
        raise ValueError(f"{path} is not a file of edits of warpgs")
    if (version := values.pop("version", None)) != VERSION:
        raise ValueError(f"{path} has version {reprlib.repr(version)}, this program reads {VERSION}")
    identity = _parsed_identity(path, values.pop("checkpoint", None))
    known = [field.name for field in dataclasses.fields(Edits)]
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{path} has an unknown edit {unknown[0][:60]!r}, expected some of {', '.join(known)}")
    parsed = {name: _parsed(path, name, values) for name in values}
    try:
        check(Edits(**parsed))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Edits(**parsed), identity


def _parsed_identity(path: Path, values: Any) -> Identity | None:
    if values is None:
        return None
    identity = Identity(**values) if isinstance(values, dict) and {*values} == {*Identity._fields} else None
    if identity is None or type(identity.iteration) is not int or type(identity.fingerprint) is not str:
        raise ValueError(f"{path}: checkpoint must have an iteration and a fingerprint, got {reprlib.repr(values)}")
    return identity


def _check_identity(path: Path, identity: Identity | None, now: Identity) -> None:
    """Raises ValueError unless numbers in a file are of the scene of now."""
    if identity == now:
        return
    if identity is None:
        former = "does not say which checkpoint its numbers of objects or Gaussians are of"
    elif identity.iteration != now.iteration:
        former = (
            f"has numbers of objects or Gaussians at iteration {identity.iteration:,}, "
            f"but the run is at {now.iteration:,}"
        )
    else:
        former = f"has numbers of objects or Gaussians of another training up to iteration {now.iteration:,}"
    raise ValueError(f"{path} {former}: delete the file or give --edits none, and choose them anew")


def _check_effect(given: Edits, edits: Edits) -> None:
    """Raises ValueError if an object that is given a change is removed by the edits in use."""
    for option in ("recolor", "freeze", "shift"):
        for name, *_ in getattr(given, option):
            nothing = f"--{option} {name} would change nothing, because"
            if name in split_names(edits.remove):
                raise ValueError(f"{nothing} --remove {edits.remove} removes it: omit {name} there")
            if edits.objects is not None and name not in split_names(edits.objects):
                raise ValueError(f"{nothing} --objects {edits.objects} removes it: add {name} to --objects")


def check(edits: Edits) -> None:
    """Raises ValueError if a value is out of its range; the message has the option."""
    if edits.crop is not None:
        _check_box("--crop", edits.crop)
    _check_objects(edits)
    if edits.min_opacity is not None and not 0 <= edits.min_opacity <= 1:
        raise ValueError(f"--min-opacity must be in [0, 1], got {edits.min_opacity}")
    if edits.max_gaussians is not None and edits.max_gaussians < 1:
        raise ValueError(f"--max-gaussians must be at least 1, got {edits.max_gaussians}")


def _check_box(option: str, box: Sequence[float]) -> None:
    if not all(abs(value) <= MAX_NUMBER for value in box):
        raise ValueError(f"{option} must be six numbers of at most {MAX_NUMBER:g}, got {_listed(box)}")
    if any(box[axis] == box[axis + 3] for axis in range(3)):
        raise ValueError(f"{option} must be opposite corners of a box, got {_listed(box)}")


def _check_objects(edits: Edits) -> None:
    for name, *box in edits.box:
        if not BOX_NAME.fullmatch(name):
            raise ValueError(f"--box must have a name that begins with a letter, got {reprlib.repr(name)}")
        _check_box(f"--box {name}", box)
    for option, rows, (low, high) in (
        ("--recolor", edits.recolor, (0.0, 1.0)),
        ("--freeze", edits.freeze, (0.0, 1.0)),
        ("--shift", edits.shift, (-1.0, 1.0)),
    ):
        for name, *values in rows:
            if not all(low <= value <= high for value in values):
                raise ValueError(f"{option} {name} must be in [{low:g}, {high:g}], got {_listed(values)}")
    timed = [*(name for name, _ in edits.freeze), *(name for name, _ in edits.shift)]
    for option, names in (
        ("--box", [name for name, *_ in edits.box]),
        ("--recolor", [name for name, *_ in edits.recolor]),
        ("--freeze or --shift", timed),
    ):
        if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
            raise ValueError(f"{option} was given twice for {twice}")


def names_of(edits: Edits) -> list[str]:
    """The names of the edits that change something."""
    return [field.name for field in dataclasses.fields(Edits) if getattr(edits, field.name) != field.default]


def _parsed(path: Path, name: str, values: dict[str, Any]) -> Any:
    """The value of an edit in a file."""
    if name in ROWS:
        rows, parsed = values[name], []
        if not isinstance(rows, list) or not all(isinstance(row, list) and row for row in rows):
            raise ValueError(f"{path}: {name} must be a list of lists, got {reprlib.repr(rows)}")
        for object_name, *numbers in rows:
            if not isinstance(object_name, str):
                raise ValueError(f"{path}: {name} needs the name of an object, got {reprlib.repr(object_name)}")
            parsed.append((object_name, *read_numbers(path, {name: numbers}, name, (ROWS[name],)).tolist()))
        return tuple(parsed)
    if name == "crop":
        return tuple(read_numbers(path, values, name, (6,)).tolist())
    if name == "erased":
        return parse_marked(path, name, values[name])
    if name == "min_opacity":
        return float(read_numbers(path, values, name, ()))
    kind, value = {"drop_floaters": bool, "max_gaussians": int}.get(name, str), values[name]
    if type(value) is not kind:
        raise ValueError(f"{path}: {name} cannot be {reprlib.repr(value)}")
    return value


def _listed(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
