"""Tables as Markdown, LaTeX and CSV, and for a terminal."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import rich.table
from rich.box import SIMPLE_HEAD
from rich.text import Text

from warpgs.evaluation.metric import Metric

from .cells import Cell
from .table import Row, Statistic, Table, best_means

NOTHING = "–"
"""Stands where nothing was measured."""

SPREAD = "Mean ± standard deviation over seeds."

LATEX = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
    "×": r"$\times$",
    "|": r"\textbar{}",
    "`": r"\textasciigrave{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
}
ARROWS = {"higher": "↑", "lower": "↓", "": ""}


def statistic(metric: Metric, value: Statistic | None) -> str:
    """Mean ± standard deviation."""
    if value is None:
        return NOTHING
    spread = "" if value.deviation is None else f" ± {metric.number(value.deviation)}"
    return metric.number(value.mean) + spread


def seeds(row: Row) -> str:
    """How many seeds are in the means of a line."""
    if not row.planned:
        return NOTHING
    return str(row.done) if row.is_complete else f"{row.done} of {row.planned}"


def texts(table: Table) -> list[list[tuple[str, bool]]]:
    """Every line as (text, whether it is the best of its column): the values, then the seeds."""
    best = best_means(table)
    return [
        [
            *(
                (
                    statistic(metric, value),
                    row.is_complete and value is not None and round(value.mean, metric.digits) == top,
                )
                for metric, value, top in zip(table.metrics.values(), row.values, best, strict=True)
            ),
            (seeds(row), False),
        ]
        for row in table.rows
    ]


def heads(table: Table) -> list[str]:
    """Titles of the columns, after the first."""
    return [*(f"{metric.heading} {ARROWS[metric.better]}".strip() for metric in table.metrics.values()), "seeds"]


def markdown(title: str, tables: Sequence[Table], notes: Sequence[str]) -> str:
    """A document with all tables and, below them, notes (one paragraph each)."""
    parts = [f"# {title}", SPREAD]
    for table in tables:
        lines = [["", *heads(table)], ["---"] * (len(table.metrics) + 2)]
        for row, cells in zip(table.rows, texts(table), strict=True):
            lines.append(
                [row.label.replace("|", r"\|"), *(f"**{text}**" if is_best else text for text, is_best in cells)]
            )
        parts += [f"## {table.title}", "\n".join(f"| {' | '.join(line)} |" for line in lines)]
    return "\n\n".join([*parts, *notes]) + "\n"


def terminal(table: Table) -> rich.table.Table:
    """A table for a terminal, which breaks lines between words where it is narrow; the best values are bold."""
    lines = [[(row.label, False), *cells] for row, cells in zip(table.rows, texts(table), strict=True)]
    columns: list[rich.table.Column] = []
    for head, *cells in zip(["", *heads(table)], *([text for text, _ in line] for line in lines), strict=True):
        longest = max(len(word) for text in (head, *cells) for word in text.split() or [""])
        justify: Literal["left", "right"] = "right" if columns else "left"
        columns.append(rich.table.Column(Text(head), justify=justify, vertical="bottom", min_width=longest))
    style: dict[str, Any] = {"box": SIMPLE_HEAD, "show_edge": False, "padding": (0, 1, 0, 0), "title_justify": "left"}
    shown = rich.table.Table(*columns, title=Text(table.title), **style)
    for line in lines:
        # Without markup: labels may have brackets.
        shown.add_row(*(Text(text, "bold" if is_best else "") for text, is_best in line))
    return shown


def latex(title: str, tables: Sequence[Table], notes: Sequence[str]) -> str:
    """A ``table`` environment for each table and, below them, notes; needs the package booktabs."""
    return "\n".join([*(_latex_table(title, table) for table in tables), *(f"{escaped(note)}\n" for note in notes)])


def _latex_table(title: str, table: Table) -> str:
    arrows = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", "": ""}
    titles = [escaped(metric.heading) + arrows[metric.better] for metric in table.metrics.values()]
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{escaped(title)}: {escaped(table.title)}. Mean $\pm$ standard deviation over seeds.}}",
        rf"\begin{{tabular}}{{l{'r' * (len(titles) + 1)}}}",
        r"\toprule",
        " & ".join(["", *titles, "seeds"]) + r" \\",
        r"\midrule",
    ]
    for row, cells in zip(table.rows, texts(table), strict=True):
        values = [rf"\textbf{{{escaped(text)}}}" if is_best else escaped(text) for text, is_best in cells]
        lines.append(" & ".join([escaped(row.label), *values]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def escaped(text: str) -> str:
    """A text for LaTeX."""
    return "".join(LATEX.get(c, c) for c in text)


def cells_csv(cells: Sequence[tuple[Cell, str, str, Mapping[str, Any] | None]]) -> str:
    """One line per cell: name, capture, variant, seed, state, error, every metric, command."""
    names = list(dict.fromkeys(name for *_, metrics in cells for name in metrics or {}))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["cell", "capture", "variant", "seed", "state", "error", *names, "command"])
    for cell, state, error, metrics in cells:
        values = [(metrics or {}).get(name) for name in names]
        row = [cell.name, cell.scene, cell.variant, cell.seed, state, error]
        writer.writerow([*row, *("" if value is None else value for value in values), cell.command])
    return text.getvalue()


def means_csv(tables: Sequence[Table]) -> str:
    """One line per line of every table: mean and standard deviation of each metric, unrounded, and numbers of seeds."""
    metrics = {name: metric for table in tables for name, metric in table.metrics.items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    pairs = [name for metric in metrics.values() for name in (metric.heading, f"{metric.heading} deviation")]
    writer.writerow(["table", "row", *pairs, "seeds", "planned seeds"])
    for table in tables:
        for row in table.rows:
            found = dict(zip(table.metrics, row.values, strict=True))
            numbers = [n for key in metrics for n in (found.get(key) or (None, None))]
            counts = [row.done, row.planned] if row.planned else ["", ""]
            writer.writerow([table.title, row.label, *("" if n is None else n for n in numbers), *counts])
    return text.getvalue()
