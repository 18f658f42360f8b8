"""The HTML page; ``text`` escapes every string that comes from a run folder."""

import html
import math
import statistics
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from typing import Any, NamedTuple

from warpgs.command_line.version import version
from warpgs.evaluation.metrics import METRICS
from warpgs.visualize.images import ERROR_RANGE

from .charts import Series, chart, color_of
from .evaluated_run import EvaluatedRun, groups
from .image_strips import Strips
from .metrics_table import config_rows, formatted, heading, summary_rows

CURVES = ("psnr/train", "loss/total")
"""Tags of the first charts."""

STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #888; }
body { font: 14px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1500px; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; } td, th { padding: .15rem .7rem; border-bottom: 1px solid var(--line); }
th { text-align: left; font-weight: 600; } td { text-align: right; font-variant-numeric: tabular-nums; }
td.text { text-align: left; } td.best { font-weight: 700; } .note { color: var(--soft); }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 24rem), 1fr)); gap: 1rem; }
svg text { fill: currentColor; font-size: 11px; } svg .title { font-size: 13px; font-weight: 600; }
svg .tick { fill: var(--soft); } svg line { stroke: var(--line); }
svg polyline { fill: none; stroke-width: 1.6; }
svg .value { fill: transparent; } svg .value:hover { fill: currentColor; }
.wide, .strips { overflow-x: auto; scrollbar-width: thin;
  background: linear-gradient(90deg, Canvas 30%, transparent) left,
  linear-gradient(-90deg, Canvas 30%, transparent) right, linear-gradient(90deg, #8888, transparent) left,
  linear-gradient(-90deg, #8888, transparent) right; background-repeat: no-repeat;
  background-size: 3rem 100%, 3rem 100%, 1rem 100%, 1rem 100%; background-attachment: local, local, scroll, scroll; }
.dot { display: inline-block; width: .75em; height: .75em; border-radius: 50%; margin-right: .4em; }
.strips td { border: 0; padding: .15rem; vertical-align: top; text-align: left; }
.strips th { border: 0; padding: .15rem .3rem; }
.strips img { display: block; width: clamp(140px, (min(100vw, 1500px) - 5rem) / var(--columns) - .3rem, 300px); }
.zoom { position: relative; display: block; cursor: zoom-in; }
.zoom input { position: absolute; opacity: 0; }
.zoom input:focus-visible + img { outline: 2px solid; }
.zoom input:checked + img { position: fixed; inset: 0; z-index: 1; width: 100vw; height: 100vh; object-fit: contain;
  background: #000d; cursor: zoom-out; }
@media (max-width: 600px) { body { margin: 1rem auto; padding: 0 .6rem; } td, th { padding: .15rem .35rem; } }
"""

PER_RUN = ("rendered", "static", "dynamic", "error")
"""Images of a run beside the truth; fields of ``Strip``."""

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""Content security policy: the page loads nothing."""


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


def text(value: object) -> str:
    """A value as text, escaped for HTML."""
    return html.escape(str(value), quote=True)


def page(runs: Sequence[EvaluatedRun], galleries: Sequence[Gallery], title: str = "", introduction: str = "") -> str:
    """The whole page; it says when and by which version it was written.

    Args:
        runs: Runs, shown side by side; nothing is shown of them if there are none.
        galleries: Images of runs on the same views.
        title: Title; the runs' labels if empty.
        introduction: HTML above everything about the runs.
    """
    written = f"written {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC by warpgs {version()}"
    title = title or f"warpgs: {', '.join(run.label for run in runs)}"
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width"><title>{text(title)}</title><style>{STYLE}</style>'
    )
    sections = [
        f"<h1>{text(title)}</h1><p class=note>{text(written)}</p>",
        introduction,
    ]
    if runs:
        galleries_html = [_gallery(runs, gallery) for gallery in galleries]
        sections += [_summary(runs), _charts(runs), *galleries_html, _views(runs), _config(runs)]
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{chr(10).join(sections)}\n</body></html>\n'


def _named(runs: Sequence[EvaluatedRun], index: int) -> str:
    return f'<span class="dot" style="background:{color_of(index)}"></span>{text(runs[index].label)}'


def _header(runs: Sequence[EvaluatedRun], first: str = "") -> str:
    names = "".join(f"<th>{_named(runs, k)}</th>" for k in range(len(runs)))
    return f"<tr><th>{text(first)}</th>{names}</tr>"


def _summary(runs: Sequence[EvaluatedRun]) -> str:
    rows, are_comparable = [], len(groups(runs)) == 1
    for name, values, texts in summary_rows(runs):
        best = _best(name, values) if are_comparable else None
        cells = "".join(
            f"<td{' class=best' if best is not None and value == best else ''}>{text(formatted)}</td>"
            for value, formatted in zip(values, texts, strict=True)
        )
        rows.append(f"<tr><th>{text(heading(name))}</th>{cells}</tr>")
    note = "" if are_comparable else "<p class=note>The runs were evaluated on different captures or views.</p>"
    return f"<h2>Metrics and timing</h2>{note}{wide(_header(runs) + ''.join(rows))}"


def _best(name: str, values: Iterable[Any]) -> float | None:
    known = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(known) < 2 or name not in METRICS or not METRICS[name].better:
        return None
    return max(known) if METRICS[name].better == "higher" else min(known)


def _charts(runs: Sequence[EvaluatedRun]) -> str:
    tags = dict.fromkeys(tag for run in runs for tag in run.curves)
    ordered = [*(tag for tag in CURVES if tag in tags), *sorted(tag for tag in tags if tag not in CURVES)]
    by_tag = [
        chart(tag, "iteration", [Series(r.label, color_of(k), r.curves.get(tag, [])) for k, r in enumerate(runs)])
        for tag in ordered
    ]
    without_events = [run.label for run in runs if not run.curves]
    note = f"<p class=note>Without TensorBoard events: {text(', '.join(without_events))}</p>" if without_events else ""
    by_view = [
        chart(f"{heading(name)} of each view", "time", [_over_time(k, r, name) for k, r in enumerate(runs)], dots=True)
        for name, metric in METRICS.items()
        if metric.of_view is not None and metric.line == "views"
    ]
    legend = " ".join(_named(runs, k) for k in range(len(runs)))
    return f'<h2>Curves</h2><p>{legend}</p>{note}<div class="charts">{"".join(by_tag)}{"".join(by_view)}</div>'


def _over_time(index: int, run: EvaluatedRun, name: str) -> Series:
    known = [(view.time, value) for view in run.views if (value := view.values.get(name)) is not None]
    return Series(run.label, color_of(index), sorted((t, v) for t, v in known if math.isfinite(v)))


def _gallery(runs: Sequence[EvaluatedRun], gallery: Gallery) -> str:
    names = "".join(f"<th colspan={len(PER_RUN)}>{_named(runs, k)}: {' | '.join(PER_RUN)}</th>" for k in gallery.runs)
    named: dict[str, list[str]] = {}  # labels by note: a sentence once, not for each run
    for k, strips in zip(gallery.runs, gallery.strips, strict=True):
        named.setdefault(strips.note, []).append(runs[k].label)
    notes = "".join(
        f"<p class=note>{'' if len(named) == 1 else text(', '.join(found)) + ': '}{text(note)}</p>"
        for note, found in named.items()
        if note
    )
    rows = []
    for title, views in (("Worst views", gallery.worst), ("Best views", gallery.best)):
        if views:
            rows.append(f"<tr><th>{title}: ground truth</th>{names}</tr>")
        rows += [_gallery_row(runs, gallery, view) for view in views]
    columns = 1 + len(PER_RUN) * len(gallery.runs)
    error = f"mean absolute error over the channels, black at 0, brightest from {ERROR_RANGE} on"
    order = "PSNR" if len(gallery.runs) == 1 else "the mean PSNR of the runs"
    scale = f"<p class=note>Ordered by {order}. Error: {error}.</p>"
    table = f'<div class="strips" tabindex=0 style="--columns: {columns}"><table>{"".join(rows)}</table></div>'
    labels = "" if len(gallery.runs) == len(runs) else f" of {', '.join(_named(runs, k) for k in gallery.runs)}"
    return f"<h2>Worst and best views{labels}</h2>{scale}{notes}{table}"


def _gallery_row(runs: Sequence[EvaluatedRun], gallery: Gallery, name: str) -> str:
    truths = [strips.by_view[name].truth for strips in gallery.strips if name in strips.by_view]
    scores = [view.values.get("psnr") for k in gallery.runs for view in runs[k].views if view.name == name]
    known = [score for score in scores if score is not None]
    mean = f"<br>mean {statistics.fmean(known):.2f} dB" if len(scores) > 1 and known else ""
    image = _image(truths[0], f"ground truth of {name}") if truths else ""
    cells = [f"<td>{image}{text(name)}{mean}</td>"]
    for index, strips in zip(gallery.runs, gallery.strips, strict=True):
        view = next(view for view in runs[index].views if view.name == name)
        psnr = view.values.get("psnr")
        quality = "" if psnr is None else f"{psnr:.2f} dB"
        if name not in strips.by_view:
            cells.append(f"<td colspan={len(PER_RUN)}>{text(quality)} (no image)</td>")
            continue
        strip = strips.by_view[name]
        for part in PER_RUN:
            below = text(quality) if part == "rendered" else ""
            cells.append(f"<td>{_image(getattr(strip, part), f'{part} of {name}')}{below}</td>")
    return f"<tr>{''.join(cells)}</tr>"


def _views(runs: Sequence[EvaluatedRun]) -> str:
    parts = ["<h2>All views</h2>"]
    for index, run in enumerate(runs):
        names = dict.fromkeys(name for view in run.views for name, v in view.values.items() if v is not None)
        head = "".join(f"<th>{text(heading(name))}</th>" for name in ("view", "time", *names))
        rows = "".join(
            f"<tr><td class=text>{text(view.name)}</td><td>{view.time:.4f}</td>"
            + "".join(
                f"<td>{'' if (value := view.values.get(name)) is None else formatted(name, value)}</td>"
                for name in names
            )
            + "</tr>"
            for view in run.views
        )
        opened = " open" if len(runs) == 1 else ""
        parts.append(
            f"<details{opened}><summary>{_named(runs, index)}: {len(run.views)} views</summary>"
            f"{wide(f'<tr>{head}</tr>{rows}')}</details>"
        )
    return "".join(parts)


def _config(runs: Sequence[EvaluatedRun]) -> str:
    rows = config_rows([run.config for run in runs])
    title = (
        "Settings that differ" if len(runs) > 1 else "Settings as this run had them, where they differ from the preset"
    )
    if not rows:
        return f"<h2>{title}</h2><p class=note>none</p>"
    body = "".join(
        f"<tr><th>{text(name)}</th>{''.join(f'<td class=text>{text(value)}</td>' for value in values)}</tr>"
        for name, values in rows
    )
    return f"<h2>{title}</h2>{wide(_header(runs) + body)}"


def wide(rows: str) -> str:
    """A table that scrolls sideways where the screen is narrower, with shadows at the ends where it goes on."""
    return f'<div class="wide" tabindex=0><table>{rows}</table></div>'


def _image(address: str, description: str) -> str:
    """An image that fills the window after a click, and no longer after another one; pages have no scripts."""
    label = f'<input type="checkbox" aria-label="enlarge: {text(description)}">'
    return f'<label class="zoom">{label}<img src="{text(address)}" alt="{text(description)}"></label>'
