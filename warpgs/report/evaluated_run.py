"""Reading the results of a run folder."""

import csv
import logging
import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

from warpgs.config import TrainConfig
from warpgs.errors import command
from warpgs.evaluation.evaluate import ViewMetrics
from warpgs.evaluation.metrics import METRICS
from warpgs.files import read_bounded, read_json, require_file
from warpgs.runs.config_file import read_config

Curve = list[tuple[float, float]]
"""(iteration, value), in the order of iterations."""

MAX_FILE = 64 << 20
"""Maximum size of metrics.json and of views.csv [bytes]."""

MAX_EVENTS = 1 << 30
"""Maximum size of an event file of TensorBoard [bytes]; one of 100,000 iterations has about 20 MB."""

MAX_VALUE = 1e18
"""Maximum magnitude of their numbers."""

REQUIRED = ("name", "time", "psnr")
"""Required columns of views.csv; all others are metrics like psnr."""


@dataclass(frozen=True)
class EvaluatedRun:
    """A run that was evaluated.

    Attributes:
        label: Unique name of the run in the report.
        folder: Run folder.
        config: Its config.
        metrics: Content of metrics.json.
        views: Lines of views.csv.
        curves: Scalars of TensorBoard by tag; empty without event files.
    """

    label: str
    folder: Path
    config: TrainConfig
    metrics: dict[str, Any]
    views: list[ViewMetrics]
    curves: dict[str, Curve]


def groups(runs: Sequence[EvaluatedRun]) -> list[list[int]]:
    """Indices of the runs that were evaluated on the same views of the same capture."""
    found: dict[tuple[object, ...], list[int]] = {}
    for index, run in enumerate(runs):
        key = (run.config.data, run.config.factor, *sorted(view.name for view in run.views))
        found.setdefault(key, []).append(index)
    return list(found.values())


def read_runs(folders: Sequence[Path]) -> list[EvaluatedRun]:
    """The runs of a report.

    Raises:
        ValueError: If there is none, or one is not a run folder, not evaluated, of another version or damaged; the
            message names the file.
    """
    if not folders:
        raise ValueError("a report needs at least one run folder")
    names = [folder.resolve().name for folder in folders]
    labels = [name if names.count(name) == 1 else str(folder) for name, folder in zip(names, folders, strict=True)]
    if len(set(labels)) < len(labels):
        raise ValueError(f"{next(label for label in labels if labels.count(label) > 1)} is given twice")
    return [_read(label, folder) for label, folder in zip(labels, folders, strict=True)]


def _read(label: str, folder: Path) -> EvaluatedRun:
    config = read_config(folder)
    metrics = read_metrics(folder)
    views, curves = _read_views(folder / "views.csv"), _read_curves(folder / "events")
    return EvaluatedRun(label, folder, config, metrics, views, curves)


def read_metrics(folder: Path) -> dict[str, Any]:
    """The content of metrics.json of a run folder: numbers, texts, lists of texts, yes or no; None where not measured.

    Raises:
        ValueError: If the run was not evaluated, or the file is damaged; the message names it.
    """
    path = folder / "metrics.json"
    _check_evaluated(path)
    values = read_json(path, max_bytes=MAX_FILE)
    texts = [text for value in values.values() if isinstance(value, list) for text in value]
    if any(isinstance(value, dict) for value in values.values()) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{path} is damaged: expected an object with numbers and strings")
    for name, value in values.items():
        is_text = isinstance(value, str | list) and name in METRICS
        if is_text or (isinstance(value, int | float) and not abs(value) <= MAX_VALUE):
            raise ValueError(f"{path} is damaged: {reprlib.repr(name)} cannot be {reprlib.repr(value)}")
    return values


def _check_evaluated(path: Path) -> None:
    """Refuses a run folder without a file that the evaluation writes."""
    if not path.exists():
        raise ValueError(f"{path.parent} has no {path.name}: evaluate it with {command('eval', path.parent)}")


def _read_views(path: Path) -> list[ViewMetrics]:
    _check_evaluated(path)
    data = read_bounded(path, MAX_FILE)
    try:
        lines = list(csv.reader(data.decode().splitlines(), strict=True))
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    header, *rows = lines or [[]]
    if missing := [name for name in REQUIRED if name not in header]:
        raise ValueError(f"{path} has columns of another version: it has no {', '.join(missing)}")
    return [_view(path, number, header, row) for number, row in enumerate(rows, 2)]


def _view(path: Path, line: int, header: list[str], row: list[str]) -> ViewMetrics:
    if len(row) != len(header):
        raise ValueError(f"{path} is damaged: line {line} has {len(row)} columns, not {len(header)}")
    texts = dict(zip(header, row, strict=True))
    name = texts.pop("name")
    values = {key: _metric(f"{path}: line {line}: {key}", text) for key, text in texts.items()}
    time = values.pop("time") or 0.0
    if math.isinf(time):
        raise ValueError(f"{path}: line {line}: time cannot be infinite")
    return ViewMetrics(name, time, values)


def _metric(name: str, text: str) -> float | None:
    """A metric; the PSNR of a perfect image is infinite."""
    try:
        value = float(text) if text else math.nan
    except ValueError as error:
        raise ValueError(f"{name} cannot be {reprlib.repr(text)}") from error
    if math.isnan(value):
        return None
    if value != math.inf and not abs(value) <= MAX_VALUE:
        raise ValueError(f"{name} cannot be {reprlib.repr(text)}")
    return value


def _read_curves(folder: Path) -> dict[str, Curve]:
    """The scalars of TensorBoard's event files; damaged parts are skipped, as in TensorBoard."""
    files = sorted(folder.glob("*tfevents*"))
    if not files:
        return {}
    for path in files:
        require_file(path, MAX_EVENTS)
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    events = EventAccumulator(str(folder), size_guidance={SCALARS: 0})
    try:
        events.Reload()
    except Exception as error:  # its parser raises errors of many types for a damaged file
        raise ValueError(f"{folder} is damaged: {error}") from error
    curves = {tag: [(float(e.step), float(e.value)) for e in events.Scalars(tag)] for tag in events.Tags()[SCALARS]}
    return {tag: [(x, y) for x, y in curve if abs(y) <= MAX_VALUE] for tag, curve in curves.items()}
