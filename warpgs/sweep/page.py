"""The HTML report of a sweep: its tables, then the report of one run of each variant and capture."""

from collections.abc import Sequence
from pathlib import Path

from warpgs.files import write_text
from warpgs.report.evaluated_run import groups, read_runs
from warpgs.report.image_strips import saved_strips, saved_views
from warpgs.report.page import Gallery, TextTable, page
from warpgs.report.write_report import extremes

from .cells import Cell
from .formats import heads, texts
from .table import Table

NUM_VIEWS = 2
"""Worst and best views of each capture; those whose images the evaluation saved."""

REASON = "a sweep's report renders nothing"


def write_page(path: Path, title: str, tables: Sequence[Table], notes: Sequence[str], cells: Sequence[Cell]) -> None:
    """Writes the report.

    Below the tables are the notes, a paragraph each, then curves and images of finished cells.

    Raises:
        ValueError: If results of a cell are damaged.
        OSError: If the file cannot be written.
    """
    runs = read_runs([cell.folder for cell in cells]) if cells else []
    galleries = []
    for group in groups(runs):
        chosen = [runs[k] for k in group]
        worst, best = extremes(chosen, NUM_VIEWS, set.intersection(*map(saved_views, chosen)))
        if worst:
            strips = [saved_strips(run, [*worst, *best], REASON) for run in chosen]
            galleries.append(Gallery(group, worst, best, strips))
    write_text(path, page(runs, galleries, title, [_texts(table) for table in tables], notes))


def _texts(table: Table) -> TextTable:
    rows = zip((row.label for row in table.rows), texts(table), strict=True)
    return TextTable(table.title, ("", *heads(table)), list(rows))
