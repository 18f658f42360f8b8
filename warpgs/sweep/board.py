"""The state of every cell, as files say it, and as a table in the terminal."""

import csv
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Any

from rich import get_console
from rich.box import SIMPLE_HEAD
from rich.live import Live
from rich.table import Column, Table
from rich.text import Text

from warpgs.config import scaled
from warpgs.files import read_bounded
from warpgs.runs.checkpoint import list_checkpoints
from warpgs.runs.logger import LINE
from warpgs.training.schedule import Protocol

from .cells import Cell, arguments, evaluation_arguments, finished_metrics, is_evaluated
from .scheduler import Event
from .worker import STARTED, Job, last_lines

CELLS = "cells.csv"
"""File in the folder of a sweep with the state of each cell, and why those failed that did."""

MAX_BYTES = 64 << 20
"""Maximum size of that file, and of those that name the hosts of cells that run [bytes]."""

MAX_LINES = 30
"""Maximum number of cells in the live table; those that run and fail come first."""

FRAME_LINES = 5
"""Lines of a terminal that the live table needs besides its cells: title, heads, rule and cursor."""

NOTE = "host / error"
HEADS = ("cell", "state", "iterations", "time left", "PSNR [dB]", NOTE)

REFRESH_SECONDS = 2.0
ORDER = ("running", "failed", "retried", "lost", "queued", "stopped", "finished")


class Board:
    """Cells and what happens to them; a context that shows a live table if stdout is a terminal.

    If stdout is no terminal, ``log`` receives a line for each event.

    Attributes:
        metrics: Results by name of the cell, of those that have finished, also if they are to be evaluated again.
        errors: Last error by name of the cell.
        states: State by name of the cell: queued, running, retried, lost, failed, stopped or finished.
    """

    def __init__(self, out: Path, cells: Sequence[Cell], log: Any) -> None:
        self.out, self.cells, self._log = out, cells, log
        self.metrics: dict[str, Mapping[str, Any]] = {}
        self.errors: dict[str, str] = {}
        self.states: dict[str, str] = {}
        self._hosts: dict[str, str] = {}
        self._live: Live | None = None
        self._refreshed = 0.0
        for cell in cells:
            self.read(cell)

    def read(self, cell: Cell) -> None:
        """Reads whether a cell has finished, and with which results."""
        try:
            metrics = finished_metrics(cell)
        except ValueError as error:
            metrics, self.errors[cell.name] = None, str(error)
        is_done = metrics is not None and is_evaluated(cell, metrics)
        self.states[cell.name] = "finished" if is_done else "queued"
        if metrics is not None:
            self.metrics[cell.name] = metrics

    def recall(self) -> None:
        """Takes note of what had not finished when the sweep ended, and why, as ``CELLS`` says."""
        path = self.out / CELLS
        text = read_bounded(path, MAX_BYTES).decode("utf-8", "replace") if path.is_file() else ""
        try:
            lines = list(csv.DictReader(text.splitlines()))
        except csv.Error as damage:
            raise ValueError(f"{path} is damaged: {damage}") from damage
        for line in lines:
            name, state, error = (line.get(key) or "" for key in ("cell", "state", "error"))
            if error and self.states.get(name, "finished") != "finished":
                self.errors[name] = error
                if state == "failed":
                    self.states[name] = state

    def give_up(self, problems: Mapping[str, str]) -> None:
        """Marks what has not finished as failed, on the captures that have a problem."""
        for cell in self.unfinished():
            if cell.scene in problems:
                self.states[cell.name], self.errors[cell.name] = "failed", problems[cell.scene]

    def jobs(self, device: str) -> list[Job]:
        """What is left to do, in the order in which it starts."""
        return [
            Job(
                name=cell.name,
                folder=str(cell.folder),
                log=str(self._log_of(cell)),
                running=str(self._running / cell.name),
                arguments=tuple(arguments(cell.config)),
                device=device,
                evaluation=tuple(evaluation_arguments(cell.config)),
                is_trained=cell.name in self.metrics,
            )
            for cell in longest_first(self.unfinished())
        ]

    def unfinished(self) -> list[Cell]:
        """The cells to train or to evaluate, in the order of the tables."""
        return [cell for cell in self.cells if self.states[cell.name] not in ("finished", "failed")]

    @property
    def _running(self) -> Path:
        return self.out / "running"

    def _log_of(self, cell: Cell) -> Path:
        return self.out / "logs" / f"{cell.name}.log"

    def _progress(self, cell: Cell) -> tuple[str, str]:
        """Iterations and remaining time of a cell that runs, as its log says; empty before it trains."""
        with suppress(OSError):  # there is no log yet
            for line in reversed(last_lines(self._log_of(cell))):
                if match := LINE.fullmatch(line):
                    done, total, left = match.groups()
                    return f"{int(done):,} / {int(total):,}", left or ""
                if f": {STARTED}" in line:  # the lines above are those of an earlier attempt
                    break
        return "", ""

    def tell(self, event: Event) -> None:
        """Takes note of how an attempt ended, and says so."""
        self.states[event.name] = event.state
        cell = next(cell for cell in self.cells if cell.name == event.name)
        if event.error is None:
            self.errors.pop(event.name, None)
            self.read(cell)
            if self.states[event.name] != "finished":
                self.states[event.name], self.errors[event.name] = "failed", f"{cell.folder} has no results"
        else:
            self.errors[event.name] = event.error
            with suppress(OSError):  # what a lost node left behind
                (self._running / event.name).unlink(missing_ok=True)
        if self._live is None:
            done = sum(state in ("finished", "failed") for state in self.states.values())
            reason = f": {self.errors[event.name]}" if event.name in self.errors else ""
            self._log(f"[{done}/{len(self.cells)}] {event.name} {self.states[event.name]}{reason}")

    def stop(self) -> None:
        """Marks what has not ended as stopped."""
        for name, state in self.states.items():
            if state not in ("finished", "failed"):
                self.states[name] = "stopped"

    def poll(self) -> None:
        """Reads which cells run, and refreshes the live table."""
        if self._live is None or time.monotonic() - self._refreshed < REFRESH_SECONDS:
            return
        self._refreshed = time.monotonic()
        self._hosts = {}
        with suppress(OSError, ValueError):  # files come and go meanwhile
            for path in self._running.iterdir():
                self._hosts[path.name] = read_bounded(path, MAX_BYTES).decode("utf-8", "replace")[:60]
        self._live.update(self.table(), refresh=True)

    def table(self) -> Table:
        """The live table: one line per cell, running and failed ones first."""
        states = {
            name: "running" if name in self._hosts and state != "finished" else state
            for name, state in self.states.items()
        }
        counts = Counter(states.values())
        title = ", ".join(f"{counts[state]} {state}" for state in ORDER if counts[state])
        # Where the terminal is too narrow, notes are cut first.
        columns = [Column(Text(head, no_wrap=True), no_wrap=head != NOTE, overflow="ellipsis") for head in HEADS]
        table = Table(
            *columns, title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
        )
        num_lines = min(MAX_LINES, max(1, get_console().height - FRAME_LINES))  # what scrolls away cannot be erased
        for cell in sorted(self.cells, key=lambda cell: ORDER.index(states[cell.name]))[:num_lines]:
            psnr = self.metrics.get(cell.name, {}).get("psnr")
            note = self.errors.get(cell.name) or self._hosts.get(cell.name, "")
            progress = self._progress(cell) if states[cell.name] == "running" else ("", "")
            values = (cell.name, states[cell.name], *progress, "" if psnr is None else f"{psnr:.2f}", note)
            # Without markup: names and errors may have brackets.
            table.add_row(*(Text(value, no_wrap=True) for value in values))
        return table

    def __enter__(self) -> "Board":
        with suppress(FileNotFoundError):  # what a killed sweep left behind
            for path in self._running.iterdir():
                path.unlink()
        if sys.stdout.isatty() and get_console().is_interactive:  # which TERM=dumb is not
            self._live = Live(self.table(), transient=True, auto_refresh=False)
            self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None


def remaining_cost(cell: Cell) -> int:
    """About how long the training of a cell still takes, relative to other cells of its capture."""
    protocol = Protocol(scaled(cell.config), has_depth=cell.config.depth)
    done = max((int(path.stem) for path in list_checkpoints(cell.folder) if path.stem.isdecimal()), default=0)
    return protocol.remaining_cost(done)


def longest_first(cells: Iterable[Cell]) -> list[Cell]:
    """The cells of each seed and capture by remaining cost: a long one that starts last would run beside idle GPUs.

    Seeds and captures keep their order, so that whole tables come first, and so do cells of equal cost.
    """
    tables = groupby(cells, key=lambda cell: (cell.seed, cell.scene))
    return [cell for _, table in tables for cell in sorted(table, key=remaining_cost, reverse=True)]
