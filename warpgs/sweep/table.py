"""Means over seeds and captures: the content of every table, whatever its format."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from warpgs.evaluation.metric import Metric
from warpgs.evaluation.metrics import METRICS

ALL_SCENES = "mean"
"""Name of the table of means over captures, in peers.json, too."""


class Statistic(NamedTuple):
    """A value of a table.

    Attributes:
        mean: Mean over seeds.
        deviation: Sample standard deviation over seeds; None with one seed.
    """

    mean: float
    deviation: float | None


class Row(NamedTuple):
    """A line of a table.

    Attributes:
        label: Name of the variant or of a peer.
        values: One per metric of the table; None where not measured.
        done: Number of seeds in the means.
        planned: Number of seeds asked for; 0 for a peer.
    """

    label: str
    values: tuple[Statistic | None, ...]
    done: int
    planned: int

    @property
    def is_complete(self) -> bool:
        """Whether all seeds are in the means."""
        return self.done == self.planned


class Table(NamedTuple):
    """A table.

    Attributes:
        title: What it is about.
        metrics: Its columns, by name.
        rows: Its lines; first the variants, then the peers.
    """

    title: str
    metrics: dict[str, Metric]
    rows: tuple[Row, ...]


Measured = Mapping[tuple[str, str, int], Mapping[str, Any] | None]
"""Content of every cell's metrics.json by variant, capture and seed; None if it is not finished."""

Peers = Mapping[str, Mapping[str, Mapping[str, Statistic]]]
"""Numbers of others by method, capture and metric."""


def make_tables(measured: Measured, labels: Mapping[str, str], peers: Peers) -> list[Table]:
    """The table of means over captures, if there are several, and one for each capture.

    Captures on which nothing has finished are omitted. A mean over captures exists for a seed that has finished on
    all others: each capture counts the same.

    Args:
        measured: Results of every cell of the sweep.
        labels: Label of every variant, in the order of the lines.
        peers: Numbers of others, shown beside.
    """
    planned = len({scene for _, scene, _ in measured})
    scenes = list(dict.fromkeys(scene for (_, scene, _), metrics in measured.items() if metrics is not None))
    groups = [(scene, [scene]) for scene in scenes]
    if len(scenes) > 1:
        count = f"{planned}" if len(scenes) == planned else f"{len(scenes)} of {planned}"
        groups.insert(0, (f"Mean over {count} captures", scenes))
    tables = []
    for title, chosen in groups:
        seeds = {v: _by_seed(measured, v, chosen) for v in labels}
        rows = [_row(labels[v], found, len(chosen)) for v, found in seeds.items()]
        rows += [row for name, numbers in peers.items() if (row := _peer_row(name, numbers, chosen))]
        tables.append(_without_empty(Table(title, columns(), tuple(rows))))
    return tables


def columns() -> dict[str, Metric]:
    """The metrics of tables; a column without any value is omitted."""
    return {name: metric for name, metric in METRICS.items() if metric.is_column}


def _by_seed(measured: Measured, variant: str, scenes: Sequence[str]) -> dict[int, list[Mapping[str, Any] | None]]:
    found: dict[int, list[Mapping[str, Any] | None]] = {}
    for (own, scene, seed), metrics in measured.items():
        if own == variant and scene in scenes:
            found.setdefault(seed, []).append(metrics)
    return found


def _row(label: str, seeds: Mapping[int, list[Mapping[str, Any] | None]], num_scenes: int) -> Row:
    complete = [
        known
        for group in seeds.values()
        if len(known := [values for values in group if values is not None]) == num_scenes
    ]
    values = tuple(_statistic([_mean(name, group) for group in complete]) for name in columns())
    return Row(label, values, len(complete), len(seeds))


def _mean(name: str, group: Sequence[Mapping[str, Any]]) -> float | None:
    """Mean over captures; None unless each has the value."""
    values = [value_of(name, metrics) for metrics in group]
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def value_of(name: str, metrics: Mapping[str, Any]) -> float | None:
    """A metric of one cell, in the unit of the table; None where not measured."""
    if name == "num_gaussians":
        parts = [metrics.get("num_static"), metrics.get("num_dynamic")]
        value = sum(parts) if all(isinstance(part, int) for part in parts) else None  # type: ignore[arg-type]
    else:
        value = metrics.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return value / METRICS[name].scale


def _statistic(values: Sequence[float | None]) -> Statistic | None:
    """Mean and deviation over seeds; None unless every seed has the value."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    return Statistic(statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None)


def _peer_row(name: str, numbers: Mapping[str, Mapping[str, Statistic]], scenes: Sequence[str]) -> Row | None:
    metrics = columns()
    if len(scenes) == 1 or ALL_SCENES in numbers:
        found = numbers.get(scenes[0] if len(scenes) == 1 else ALL_SCENES, {})
        values = [found.get(key) for key in metrics]
    elif all(scene in numbers for scene in scenes):
        by_metric = [[numbers[scene].get(key) for scene in scenes] for key in metrics]
        means = [None if None in column else statistics.fmean(s.mean for s in column if s) for column in by_metric]
        values = [None if mean is None else Statistic(mean, None) for mean in means]
    else:
        return None
    scaled = tuple(value and _in_unit(value, metric) for value, metric in zip(values, metrics.values(), strict=True))
    return Row(name, scaled, 0, 0) if any(scaled) else None


def _in_unit(value: Statistic, metric: Metric) -> Statistic:
    return Statistic(value.mean / metric.scale, None if value.deviation is None else value.deviation / metric.scale)


def _without_empty(table: Table) -> Table:
    """The table without the columns in which no line has a value."""
    kept = [k for k in range(len(table.metrics)) if any(row.values[k] is not None for row in table.rows)]
    rows = tuple(row._replace(values=tuple(row.values[k] for k in kept)) for row in table.rows)
    metrics = [*table.metrics.items()]
    return Table(table.title, dict(metrics[k] for k in kept), rows)


def best_means(table: Table) -> list[float | None]:
    """The best mean of each column, as it is printed; None where no value is better than another.

    Lines that lack seeds do not compete: those that are missing may be the worst.
    """
    rows = [row for row in table.rows if row.is_complete]
    best: list[float | None] = []
    for k, metric in enumerate(table.metrics.values()):
        means = [round(value.mean, metric.digits) for row in rows if (value := row.values[k]) is not None]
        choose = {"higher": max, "lower": min}.get(metric.better)
        best.append(choose(means) if choose and len(set(means)) > 1 else None)
    return best
