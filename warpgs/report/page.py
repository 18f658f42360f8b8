"""The page: every text that comes from outside goes through ``text``."""

import html
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from warpgs.visualize import ERROR_RANGE

from .charts import Series, chart, color_of
from .figures import HIGHER, LOWER, NAMES, config_rows, summary_rows
from .record import Record
from .strips import Strips

CURVES = ("psnr/train", "loss/total")
"""Tags that come first."""

STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #888; }
body { font: 14px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1500px; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; } td, th { padding: .15rem .7rem; border-bottom: 1px solid var(--line); }
th { text-align: left; font-weight: 600; } td { text-align: right; font-variant-numeric: tabular-nums; }
td.text { text-align: left; } td.best { font-weight: 700; } .note { color: var(--soft); }
.charts { display: flex; flex-wrap: wrap; gap: 1rem; } .charts svg { width: 440px; max-width: 100%; }
svg text { fill: currentColor; font-size: 11px; } svg .title { font-size: 13px; font-weight: 600; }
svg .tick { fill: var(--soft); } svg line { stroke: var(--line); }
svg polyline { fill: none; stroke-width: 1.6; }
.dot { display: inline-block; width: .75em; height: .75em; border-radius: 50%; margin-right: .4em; }
.strips { overflow-x: auto; } .strips td { border: 0; padding: .15rem; vertical-align: top; text-align: left; }
.strips th { border: 0; padding: .15rem .3rem; }
.strips img { display: block; width: clamp(140px, (min(100vw, 1500px) - 5rem) / var(--columns) - .3rem, 300px); }
"""

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""What a browser may load for the page: nothing from anywhere."""


class Gallery(NamedTuple):
    """Pictures of runs that share a capture, side by side.

    Attributes:
        runs: Numbers of the runs.
        worst, best: Views, by their mean PSNR over the runs.
        strips: Of each run.
    """

    runs: Sequence[int]
    worst: Sequence[str]
    best: Sequence[str]
    strips: Sequence[Strips]


def text(value: object) -> str:
    """A text that means nothing to HTML."""
    return html.escape(str(value), quote=True)


def page(records: Sequence[Record], galleries: Sequence[Gallery], made: str) -> str:
    """The whole page; ``made`` says when and with what."""
    title = f"warpgs: {', '.join(record.label for record in records)}"
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width"><title>{text(title)}</title><style>{STYLE}</style>'
    )
    sections = [
        f"<h1>{text(title)}</h1><p class=note>{text(made)}</p>",
        _summary(records),
        _charts(records),
        *(_gallery(records, gallery) for gallery in galleries),
        _views(records),
        _config(records),
    ]
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{chr(10).join(sections)}\n</body></html>\n'


def _named(records: Sequence[Record], number: int) -> str:
    return f'<span class="dot" style="background:{color_of(number)}"></span>{text(records[number].label)}'


def _header(records: Sequence[Record], first: str = "") -> str:
    names = "".join(f"<th>{_named(records, k)}</th>" for k in range(len(records)))
    return f"<tr><th>{text(first)}</th>{names}</tr>"


def _summary(records: Sequence[Record]) -> str:
    rows = []
    for name, values, shown in summary_rows(records):
        best = _best(name, values) if len(records) > 1 else None
        cells = "".join(
            f"<td{' class=best' if best is not None and value == best else ''}>{text(words)}</td>"
            for value, words in zip(values, shown, strict=True)
        )
        rows.append(f"<tr><th>{text(NAMES.get(name, name))}</th>{cells}</tr>")
    return f"<h2>Figures and timing</h2><table>{_header(records)}{''.join(rows)}</table>"


def _best(name: str, values: Iterable[Any]) -> float | None:
    known = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    if not known or name not in HIGHER | LOWER:
        return None
    return max(known) if name in HIGHER else min(known)


def _charts(records: Sequence[Record]) -> str:
    tags = dict.fromkeys(tag for record in records for tag in record.curves)
    ordered = [*(tag for tag in CURVES if tag in tags), *sorted(tag for tag in tags if tag not in CURVES)]
    drawn = [
        chart(tag, "iteration", [Series(r.label, color_of(k), r.curves.get(tag, [])) for k, r in enumerate(records)])
        for tag in ordered
    ]
    silent = [record.label for record in records if not record.curves]
    note = f"<p class=note>Without TensorBoard events: {text(', '.join(silent))}</p>" if silent else ""
    by_view = [
        chart(f"{NAMES[name]} of each view", "time", [_over_time(k, r, name) for k, r in enumerate(records)], dots=True)
        for name in ("psnr", "ssim", "lpips")
    ]
    legend = " ".join(_named(records, k) for k in range(len(records)))
    return f'<h2>Curves</h2><p>{legend}</p>{note}<div class="charts">{"".join(drawn)}{"".join(by_view)}</div>'


def _over_time(number: int, record: Record, name: str) -> Series:
    known = [(view.time, value) for view in record.views if (value := view.figures.get(name)) is not None]
    return Series(record.label, color_of(number), sorted((t, v) for t, v in known if math.isfinite(v)))


def _gallery(records: Sequence[Record], gallery: Gallery) -> str:
    names = "".join(f"<th colspan=2>{_named(records, k)}: ours | error</th>" for k in gallery.runs)
    notes = "".join(
        f"<p class=note>{text(records[k].label)}: {text(strips.note)}</p>"
        for k, strips in zip(gallery.runs, gallery.strips, strict=True)
        if strips.note
    )
    rows = []
    for title, views in (("Worst views", gallery.worst), ("Best views", gallery.best)):
        if views:
            rows.append(f"<tr><th>{title}: truth</th>{names}</tr>")
        rows += [_gallery_row(records, gallery, view) for view in views]
    columns = 1 + 2 * len(gallery.runs)
    scale = f"<p class=note>By PSNR. Error: mean over colours, black at 0, bright at {ERROR_RANGE} and above.</p>"
    table = f'<div class="strips" style="--columns: {columns}"><table>{"".join(rows)}</table></div>'
    return f"<h2>Worst and best views</h2>{scale}{notes}{table}"


def _gallery_row(records: Sequence[Record], gallery: Gallery, name: str) -> str:
    truths = [strips.by_view[name].truth for strips in gallery.strips if name in strips.by_view]
    cells = [f'<td><img src="{text(truths[0])}" alt="truth">{text(name)}</td>' if truths else f"<td>{text(name)}</td>"]
    for number, strips in zip(gallery.runs, gallery.strips, strict=True):
        view = next(view for view in records[number].views if view.name == name)
        psnr = view.figures.get("psnr")
        words = "" if psnr is None else f"{psnr:.2f} dB"
        if name not in strips.by_view:
            cells.append(f"<td colspan=2>{text(words)} (no picture)</td>")
            continue
        strip = strips.by_view[name]
        cells.append(f'<td><img src="{text(strip.ours)}" alt="ours">{text(words)}</td>')
        cells.append(f'<td><img src="{text(strip.error)}" alt="error"></td>')
    return f"<tr>{''.join(cells)}</tr>"


def _views(records: Sequence[Record]) -> str:
    parts = ["<h2>Every view</h2>"]
    for number, record in enumerate(records):
        names = dict.fromkeys(name for view in record.views for name, v in view.figures.items() if v is not None)
        head = "".join(f"<th>{text(NAMES.get(name, name))}</th>" for name in ("view", "time", *names))
        rows = "".join(
            f"<tr><td class=text>{text(view.name)}</td><td>{view.time:.4f}</td>"
            + "".join(f"<td>{_number(view.figures.get(name))}</td>" for name in names)
            + "</tr>"
            for view in record.views
        )
        opened = " open" if len(records) == 1 else ""
        parts.append(
            f"<details{opened}><summary>{_named(records, number)}: {len(record.views)} views</summary>"
            f"<table><tr>{head}</tr>{rows}</table></details>"
        )
    return "".join(parts)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}" if abs(value) < 10 else f"{value:.2f}"


def _config(records: Sequence[Record]) -> str:
    rows = config_rows([record.config for record in records])
    title = "Settings that differ" if len(records) > 1 else "Settings other than the preset's"
    if not rows:
        return f"<h2>{title}</h2><p class=note>none</p>"
    body = "".join(
        f"<tr><th>{text(name)}</th>{''.join(f'<td class=text>{text(value)}</td>' for value in values)}</tr>"
        for name, values in rows
    )
    return f"<h2>{title}</h2><table>{_header(records)}{body}</table>"
