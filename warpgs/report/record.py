"""What a run folder says of its run."""

import csv
import json
import logging
import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

from warpgs.config import TrainConfig
from warpgs.files import read_bounded
from warpgs.runs.config_file import read_config

Curve = list[tuple[float, float]]
"""(iteration, value), in order."""

MAX_FILE = 64 << 20
"""Of metrics.json and of views.csv [bytes]."""

MAX_VALUE = 1e18
"""Of their numbers; bytes are the largest."""

NEEDED = ("name", "time", "psnr")
"""Columns of views.csv that a report can't do without; all others are figures like psnr."""


@dataclass(frozen=True)
class View:
    """One line of views.csv.

    Attributes:
        figures: By name; None where not measured.
    """

    name: str
    time: float
    figures: dict[str, float | None]


@dataclass(frozen=True)
class Record:
    """A run that was evaluated.

    Attributes:
        label: Its name in the report, unlike that of any other.
        metrics: metrics.json.
        curves: TensorBoard's scalars by tag; empty without events.
    """

    label: str
    folder: Path
    config: TrainConfig
    metrics: dict[str, Any]
    views: list[View]
    curves: dict[str, Curve]


def read_records(folders: Sequence[Path]) -> list[Record]:
    """The runs of a report.

    Raises:
        ValueError: If there is none, or one is no run, not evaluated, of another version or damaged; names the file.
    """
    if not folders:
        raise ValueError("a report needs at least one run folder")
    names = [folder.resolve().name for folder in folders]
    labels = [name if names.count(name) == 1 else str(folder) for name, folder in zip(names, folders, strict=True)]
    if len(set(labels)) < len(labels):
        raise ValueError(f"{next(label for label in labels if labels.count(label) > 1)} is there twice")
    return [_read(label, folder) for label, folder in zip(labels, folders, strict=True)]


def _read(label: str, folder: Path) -> Record:
    config = read_config(folder)
    metrics = _read_metrics(folder)
    return Record(label, folder, config, metrics, _read_views(folder / "views.csv"), _read_curves(folder / "events"))


def _read_metrics(folder: Path) -> dict[str, Any]:
    path = folder / "metrics.json"
    data = _of_evaluation(path)
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(values, dict) or any(isinstance(v, dict | list) for v in values.values()):
        raise ValueError(f"{path} is damaged: expected an object of numbers and texts")
    for name, value in values.items():
        if isinstance(value, int | float) and not abs(value) <= MAX_VALUE:
            raise ValueError(f"{path} is damaged: {reprlib.repr(name)} can't be {reprlib.repr(value)}")
    return values


def _of_evaluation(path: Path) -> bytes:
    """A file that the evaluation leaves in a run folder."""
    if not path.exists():
        raise ValueError(f"{path.parent} has no {path.name}: evaluate it with warpgs eval {path.parent}")
    return read_bounded(path, MAX_FILE)


def _read_views(path: Path) -> list[View]:
    data = _of_evaluation(path)
    try:
        lines = list(csv.reader(data.decode().splitlines(), strict=True))
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    header, *rows = lines or [[]]
    if lacking := [name for name in NEEDED if name not in header]:
        raise ValueError(f"{path} has columns of another version: it has no {', '.join(lacking)}")
    return [_view(path, number, header, row) for number, row in enumerate(rows, 2)]


def _view(path: Path, line: int, header: list[str], row: list[str]) -> View:
    if len(row) != len(header):
        raise ValueError(f"{path} is damaged: line {line} has {len(row)} columns, not {len(header)}")
    texts = dict(zip(header, row, strict=True))
    name = texts.pop("name")
    figures = {key: _figure(f"{path}: line {line}: {key}", text) for key, text in texts.items()}
    time = figures.pop("time") or 0.0
    if math.isinf(time):
        raise ValueError(f"{path}: line {line}: time can't be infinite")
    return View(name, time, figures)


def _figure(name: str, text: str) -> float | None:
    """A figure; the PSNR of a perfect picture is infinite."""
    try:
        value = float(text) if text else math.nan
    except ValueError as error:
        raise ValueError(f"{name} can't be {reprlib.repr(text)}") from error
    if math.isnan(value):
        return None
    if value != math.inf and not abs(value) <= MAX_VALUE:
        raise ValueError(f"{name} can't be {reprlib.repr(text)}")
    return value


def _read_curves(folder: Path) -> dict[str, Curve]:
    """The scalars of TensorBoard's events; what it can't read of a damaged file is left out, as TensorBoard does."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return {}
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    events = EventAccumulator(str(folder), size_guidance={SCALARS: 0})
    try:
        events.Reload()
    except Exception as error:  # of a damaged file it raises whatever its parser does
        raise ValueError(f"{folder} is damaged: {error}") from error
    curves = {tag: [(float(e.step), float(e.value)) for e in events.Scalars(tag)] for tag in events.Tags()[SCALARS]}
    return {tag: [(x, y) for x, y in curve if abs(y) <= MAX_VALUE] for tag, curve in curves.items()}
