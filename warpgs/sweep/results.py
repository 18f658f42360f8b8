"""The files with a sweep's results: table.md, table.tex, table.csv, cells.csv and report.html."""

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from rich import get_console

from warpgs.files import write_text

from .board import CELLS, Board
from .cells import Cell
from .formats import SPREAD, cells_csv, latex, markdown, means_csv, terminal
from .page import write_page
from .spec import SweepSpec
from .table import Peers, Table, make_tables


def tables_of(board: Board, spec: SweepSpec, peers: Peers) -> list[Table]:
    """The tables of what has finished."""
    labels = {variant.name: variant.label for variant in spec.variants}
    measured = {(cell.variant, cell.scene, cell.seed): board.metrics.get(cell.name) for cell in board.cells}
    return make_tables(measured, labels, peers)


def notes_of(board: Board) -> list[str]:
    """Paragraphs below the tables: how much has finished, and what failed and why."""
    seconds = [metrics.get("train_seconds") for metrics in board.metrics.values()]
    total = _duration(float(sum(value for value in seconds if isinstance(value, int | float))))
    notes = [f"{len(board.metrics)} of {len(board.cells)} trainings finished, {total} of training in total."]
    networks = Counter(net for metrics in board.metrics.values() if (net := metrics.get("lpips_net")))
    if len(networks) > 1:
        numbers = ", ".join(f"{net} in {count}" for net, count in networks.items())
        notes.append(f"LPIPS is of different networks ({numbers} trainings), whose distances cannot be compared.")
    reasons: dict[str, list[str]] = {}
    for name, error in board.errors.items():
        if board.states[name] != "finished":
            reasons.setdefault(error, []).append(name)
    return notes + [f"{', '.join(names)}: {error}" for error, names in reasons.items()]


def _duration(seconds: float) -> str:
    if seconds < 60.0:
        return "1 second" if round(seconds) == 1 else f"{seconds:.0f} seconds"
    return f"{seconds / 60.0:.1f} minutes" if seconds < 3600.0 else f"{seconds / 3600.0:.2f} hours"


def tables_text(spec: SweepSpec, board: Board, peers: Peers) -> str:
    """The tables as Markdown, without the commands."""
    return markdown(spec.title, tables_of(board, spec, peers), notes_of(board))


def show_tables(spec: SweepSpec, board: Board, peers: Peers, log: Callable[[str], object]) -> None:
    """Prints the tables: as tables if stdout is a terminal, else as Markdown by ``log``."""
    if not sys.stdout.isatty():
        log(tables_text(spec, board, peers))
        return
    console = get_console()
    log(f"\n{spec.title}\n{SPREAD}\n")
    for table in tables_of(board, spec, peers):
        console.print(terminal(table))
    log("\n".join(notes_of(board)))


def write_tables(out: Path, spec: SweepSpec, board: Board, peers: Peers) -> None:
    """Writes every file but the report.

    Raises:
        OSError: If a file cannot be written.
    """
    tables, commands = tables_of(board, spec, peers), "\n".join(cell.command for cell in board.cells)
    text = tables_text(spec, board, peers)
    write_text(out / "table.md", f"{text}\n## Commands\n\n```sh\n{commands}\n```\n")
    write_text(out / "table.tex", latex(spec.title, tables, notes_of(board)))
    write_text(out / "table.csv", means_csv(tables))
    lines = [
        (cell, board.states[cell.name], board.errors.get(cell.name, ""), board.metrics.get(cell.name))
        for cell in board.cells
    ]
    write_text(out / CELLS, cells_csv(lines))


def write_report(out: Path, spec: SweepSpec, board: Board, peers: Peers) -> None:
    """Writes report.html: the tables, and curves and images of the first finished seed of each variant and capture.

    Raises:
        ValueError: If results of a cell are damaged.
        OSError: If the file cannot be written.
    """
    write_page(out / "report.html", spec.title, tables_of(board, spec, peers), notes_of(board), _representatives(board))


def _representatives(board: Board) -> Sequence[Cell]:
    first: dict[tuple[str, str], Cell] = {}
    for cell in board.cells:
        if cell.name in board.metrics and (cell.folder / "views.csv").is_file():
            first.setdefault((cell.scene, cell.variant), cell)
    return list(first.values())
