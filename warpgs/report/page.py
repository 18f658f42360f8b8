"""The values of the page ``templates/report.html``."""

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, timezone
from typing import Any, NamedTuple

from markupsafe import Markup

from warpgs.command_line.version import version
from warpgs.evaluation.metrics import METRICS
from warpgs.visualize.images import ERROR_RANGE

from .charts import Series, chart, color_of
from .evaluated_run import EvaluatedRun, groups
from .image_strips import Strip, Strips
from .metrics_table import config_rows, formatted, heading, summary_rows
from .templates import render

CURVES = ("psnr/train", "loss/total")
"""Tags of the first charts."""

PER_RUN = ("rendered", "static", "dynamic", "error")
"""Images of a run beside the truth; fields of ``Strip``."""

Cells = Sequence[tuple[str, bool]]
"""Texts of a row of a table, and whether each is the best of its row or column."""


class Gallery(NamedTuple):
    """Images of runs on the same views, side by side.

    Attributes:
        runs: Indices of the runs.
        worst: Names of the views with the lowest mean PSNR over the runs.
        best: Names of the views with the highest.
        strips: Image strips of each run.
    """

    runs: Sequence[int]
    worst: Sequence[str]
    best: Sequence[str]
    strips: Sequence[Strips]


class TextTable(NamedTuple):
    """A table of texts.

    Attributes:
        title: Above it.
        heads: Of its columns, of which the first has the labels.
        rows: Label and cells of each row.
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[tuple[str, Cells]]


class Named(NamedTuple):
    """A run as the page names it."""

    label: str
    color: str


def page(
    runs: Sequence[EvaluatedRun],
    galleries: Sequence[Gallery],
    title: str = "",
    tables: Sequence[TextTable] = (),
    notes: Sequence[str] = (),
) -> str:
    """The whole page; it says when and by which version it was written.

    Args:
        runs: Runs, shown side by side; nothing is shown of them if there are none.
        galleries: Images of runs on the same views.
        title: Title; the runs' labels if empty.
        tables: Above everything about the runs.
        notes: Paragraphs below the tables.
    """
    named = [Named(run.label, color_of(k)) for k, run in enumerate(runs)]
    are_comparable = len(groups(runs)) == 1
    return render(
        "report.html",
        title=title or f"warpgs: {', '.join(run.label for run in runs)}",
        written=f"written {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC by warpgs {version()}",
        tables=tables,
        notes=notes,
        runs=named,
        are_comparable=are_comparable,
        summary=[
            (heading(name), _marked(name, values, texts, are_comparable)) for name, values, texts in summary_rows(runs)
        ],
        without_events=[run.label for run in runs if not run.curves],
        charts=[*_over_iterations(runs), *_over_views(runs)],
        error_range=ERROR_RANGE,
        galleries=[_gallery(runs, named, gallery) for gallery in galleries],
        views=[(name, *_views(run)) for name, run in zip(named, runs, strict=True)],
        settings=config_rows([run.config for run in runs]) if runs else [],
    )


def _marked(name: str, values: Sequence[Any], texts: Sequence[str], are_comparable: bool) -> Cells:
    best = _best(name, values) if are_comparable else None
    return [(text, best is not None and value == best) for value, text in zip(values, texts, strict=True)]


def _best(name: str, values: Iterable[Any]) -> float | None:
    known = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(known) < 2 or name not in METRICS or not METRICS[name].better:
        return None
    return max(known) if METRICS[name].better == "higher" else min(known)


def _over_iterations(runs: Sequence[EvaluatedRun]) -> Iterator[Markup]:
    tags = dict.fromkeys(tag for run in runs for tag in run.curves)
    for tag in [*(tag for tag in CURVES if tag in tags), *sorted(tag for tag in tags if tag not in CURVES)]:
        yield chart(tag, "iteration", [Series(r.label, color_of(k), r.curves.get(tag, [])) for k, r in enumerate(runs)])


def _over_views(runs: Sequence[EvaluatedRun]) -> Iterator[Markup]:
    for name, metric in METRICS.items():
        if metric.of_view is not None and metric.line == "views":
            series = [_over_time(k, run, name) for k, run in enumerate(runs)]
            yield chart(f"{heading(name)} of each view", "time", series, dots=True)


def _over_time(index: int, run: EvaluatedRun, name: str) -> Series:
    known = [(view.time, value) for view in run.views if (value := view.values.get(name)) is not None]
    return Series(run.label, color_of(index), sorted((t, v) for t, v in known if math.isfinite(v)))


def _gallery(runs: Sequence[EvaluatedRun], named: Sequence[Named], gallery: Gallery) -> dict[str, Any]:
    labels: dict[str, list[str]] = {}  # by note: a sentence once, not for each run
    for k, strips in zip(gallery.runs, gallery.strips, strict=True):
        labels.setdefault(strips.note, []).append(runs[k].label)
    return {
        "runs": [named[k] for k in gallery.runs],
        "is_of_all": len(gallery.runs) == len(runs),
        "parts": PER_RUN,
        "notes": [("" if len(labels) == 1 else ", ".join(of), note) for note, of in labels.items() if note],
        "views": [
            (title, [_view(runs, gallery, name) for name in names])
            for title, names in (("Worst views", gallery.worst), ("Best views", gallery.best))
        ],
    }


def _view(runs: Sequence[EvaluatedRun], gallery: Gallery, name: str) -> dict[str, Any]:
    truths = [strips.by_view[name].truth for strips in gallery.strips if name in strips.by_view]
    scores = [view.values.get("psnr") for k in gallery.runs for view in runs[k].views if view.name == name]
    known = [score for score in scores if score is not None]
    return {
        "name": name,
        "truth": truths[0] if truths else "",
        "mean": f"mean {statistics.fmean(known):.2f} dB" if len(scores) > 1 and known else "",
        "of_runs": [
            ("" if score is None else f"{score:.2f} dB", _images(strips.by_view.get(name)))
            for score, strips in zip(scores, gallery.strips, strict=True)
        ],
    }


def _images(strip: Strip | None) -> dict[str, str]:
    return {} if strip is None else strip._asdict()


def _views(run: EvaluatedRun) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """The heads and the rows of the table of a run's views."""
    names = dict.fromkeys(name for view in run.views for name, value in view.values.items() if value is not None)
    rows = [
        (
            view.name,
            [f"{view.time:.4f}"]
            + ["" if (value := view.values.get(name)) is None else formatted(name, value) for name in names],
        )
        for view in run.views
    ]
    return [heading(name) for name in ("view", "time", *names)], rows
