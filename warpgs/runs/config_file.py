"""config.json of a run folder: its plan, written and read back; and start.json: what was asked for and noted before."""

import dataclasses
import json
import reprlib
import sys
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpgs.config import Plan, TrainConfig, validate
from warpgs.config.builtin import is_builtin
from warpgs.errors import command, require_present, suggestion
from warpgs.files import read_json, write_text

from .former import FORMER, RENAMED, as_today, not_kept

NAME, START = "config.json", "start.json"
MAX_BYTES = 1 << 20
"""Size of config.json [bytes]."""


def write_config(folder: Path, config: Plan) -> None:
    """Writes config.json into a run folder, with absolute paths.

    Raises:
        OSError: If the file cannot be written.
    """
    _write(folder / NAME, _with_absolute_paths(dataclasses.replace(config, out=folder)))


def write_start(folder: Path, asked: TrainConfig, notes: Sequence[str]) -> None:
    """Writes start.json into a run folder: the config as it was asked for, and what was noted before the first step.

    Raises:
        OSError: If the file cannot be written.
    """
    _write(folder / START, {"asked": _with_absolute_paths(asked), "notes": list(notes)})


def read_notes(folder: Path) -> list[str] | None:
    """What was noted before the first step; None for runs of version 0.3 and earlier, which have no start.json.

    Raises:
        ValueError: If the file is damaged; the message names it.
    """
    if not (folder / START).exists():
        return None
    notes = read_json(folder / START, max_bytes=MAX_BYTES).get("notes")
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise ValueError(f"{folder / START} is damaged: notes cannot be {reprlib.repr(notes)}")
    return notes


def _with_absolute_paths(config: TrainConfig) -> dict[str, Any]:
    """The fields of a config, with absolute paths of the capture and of weights."""
    data = config.data if config.data is None or is_builtin(config.data) else config.data.resolve()
    weights = config.lpips and config.lpips.resolve()
    return dataclasses.asdict(dataclasses.replace(config, data=data, lpips=weights))


def _write(path: Path, values: dict[str, Any]) -> None:
    write_text(path, json.dumps(values, indent=2, default=_as_json) + "\n")


def _as_json(value: Any) -> Any:
    """A path as text; a number of NumPy or torch as one of Python."""
    return value.item() if hasattr(value, "item") else str(value)


def _instead(folder: Path) -> str:
    """What a folder without a config is, if that can be told, and what to do with it."""
    from warpgs.data.loaders import is_capture  # imports torch

    if is_capture(folder):
        return f"; it is a capture: {command('train', '--data', folder)} trains on it"
    if (folder / "checkpoints").is_dir():
        return ", without which its checkpoints cannot be opened: copy the whole run folder"
    if (folder.resolve().parent / NAME).is_file():
        return f"; it is a part of one: give {folder.resolve().parent}"
    return ""


def read_config(folder: Path) -> Plan:
    """The plan of a run folder; if it does not name a device, it is that of ``choose_device``.

    Raises:
        ValueError: If the folder or its config.json does not exist, or the file is damaged, or has unknown or mistyped
            fields, or lacks a section or a field that every version writes.
    """
    path = folder / NAME
    require_present(folder)
    if not path.exists():
        raise ValueError(f"{folder} is not a run folder: it has no {NAME}{_instead(folder)}")
    written = read_json(path, max_bytes=MAX_BYTES)
    try:
        values = as_today(written)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    plan: Plan = _parse(Plan, values, path)
    _validate(plan, path)
    return dataclasses.replace(plan, out=folder)


def require_resumable(folder: Path) -> None:
    """Refuses to train a run on that has a value of an option that is gone, with which it would become another run.

    Raises:
        ValueError: If it does; the message names the option. Such runs can be evaluated, viewed and exported.
    """
    path = folder / NAME
    if reason := not_kept(read_json(path, max_bytes=MAX_BYTES)):
        raise ValueError(f"{path} cannot be resumed: {reason}; the version that began the run can")


def require_recorded(folder: Path, is_distorted: bool) -> None:
    """Refuses to train a run of an earlier version on that was trained on undistorted frames of a distorted capture.

    Raises:
        ValueError: If it was. Such runs can be evaluated, viewed and exported.
    """
    path = folder / NAME
    written = read_json(path, max_bytes=MAX_BYTES)
    if is_distorted and written.get("undistort", "distortion" not in written):  # all were, before there was the option
        raise ValueError(
            f"{path} cannot be resumed: its frames were undistorted, and this version trains on them as they were "
            "recorded; the version that began the run can"
        )


def parse_config(values: dict[str, Any], source: Path | str) -> TrainConfig:
    """A training config from parsed JSON or TOML; newer fields that are not given are as in ``FORMER``.

    Args:
        values: Fields, nested as in ``TrainConfig``.
        source: Where they come from, for messages.

    Raises:
        ValueError: If there are unknown, missing or mistyped fields, or numbers out of their range.
    """
    config: TrainConfig = _parse(TrainConfig, values, source)
    _validate(config, source)
    return config


def _validate(config: TrainConfig, source: Path | str) -> None:
    """Raises ValueError, which names the source, if a number is out of its range."""
    try:
        validate(config)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def _parse(cls: Any, values: Any, path: Path | str, prefix: str = "") -> Any:
    """A (nested) dataclass from parsed JSON; the prefix has the names of those around it, with dots."""
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected an object for {cls.__name__}, got {reprlib.repr(values)}")
    values = {RENAMED.get(name, name): value for name, value in values.items()}
    hints = typing.get_type_hints(cls)
    if unknown := sorted(set(values) - set(hints)):
        close = suggestion(unknown[0], set(hints) - set(values))
        raise ValueError(f"{path} has fields of another version: {', '.join(unknown):.200}{close}")
    values = FORMER.get(prefix.rstrip("."), {}) | values
    if lacking := [name for name in hints if name not in values]:
        kind = "section " if dataclasses.is_dataclass(hints[lacking[0]]) else ""
        raise ValueError(
            f"{path} has no {kind}{prefix}{lacking[0]}, which every version writes: restore the file from a copy, "
            "because with defaults in its place this would be another run"
        )
    fields = {}
    for name, value in values.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            value = _parse(hint, value, path, f"{prefix}{name}.")
        elif Path in typing.get_args(hint) and isinstance(value, str):
            value = Path(value)
        elif not _matches(value, hint):
            raise ValueError(f"{path}: {prefix}{name} cannot be {reprlib.repr(value)}")
        if isinstance(value, list):
            is_float = any(float in typing.get_args(part) for part in (hint, *typing.get_args(hint)))
            value = tuple(map(float, value) if is_float else value)
        fields[name] = float(value) if hint is float else value
    return cls(**fields)


def _matches(value: Any, hint: Any) -> bool:
    if typing.get_origin(hint) is typing.Literal:
        return value in typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        items = typing.get_args(hint)
        if not isinstance(value, list | tuple):
            return False
        if items[1:] == (...,):
            items = (items[0],) * len(value)
        return len(value) == len(items) and all(map(_matches, value, items))
    if choices := typing.get_args(hint):
        return any(_matches(value, choice) for choice in choices)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return type(value) is hint
