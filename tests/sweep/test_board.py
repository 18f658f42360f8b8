"""The live table."""

import io
from unittest.mock import Mock

import pytest
from rich.console import Console

from tests.terminal import Terminal
from warpgs.runs import logger
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.progress import Status
from warpgs.sweep import board as module
from warpgs.sweep.board import Board
from warpgs.sweep.cells import plan_cells
from warpgs.sweep.results import notes_of
from warpgs.sweep.scheduler import Event
from warpgs.sweep.spec import read_spec

SWEEP = """
import sys, time
from pathlib import Path
from warpgs.sweep import board
from warpgs.sweep.cells import plan_cells
from warpgs.sweep.scheduler import Result, run_jobs
from warpgs.sweep.spec import read_spec

class Pool:
    device = "cpu"

    def submit(self, job, avoid=frozenset()): pass

    def nodes(self): return {"one"}

    def wait(self, seconds):
        time.sleep(0.05)
        return [Result("as-full-seed0", "broken")] if (out / "end").exists() else []

out, board.REFRESH_SECONDS = Path(sys.argv[1]), 0.1
cells = plan_cells(read_spec("seeds"), {"as": "/as"}, out, {"iterations": 300})[:1]
with board.Board(out, cells, print) as shown:
    run_jobs(Pool(), shown.jobs("cpu"), shown.tell, shown.poll)
print("ended")
"""


@pytest.fixture
def lines():
    return []


@pytest.fixture
def board(tmp_path, lines):
    cells = plan_cells(read_spec("seeds"), {"as": "/as"}, tmp_path, {"iterations": 300})
    return Board(tmp_path, cells, lines.append)


def text(table):
    console = Console(file=io.StringIO(), width=120)
    console.print(table)
    return [" ".join(line.replace("│", " ").split()) for line in console.file.getvalue().splitlines()]


def test_running_and_failed_cells_come_first_with_their_host_and_reason(board, tmp_path, monkeypatch):
    with board:
        (tmp_path / "running").mkdir()
        (tmp_path / "running/as-full-seed2").write_text("node7")
        board.tell(Event("as-full-seed4", "failed", "out of memory"))
        monkeypatch.setattr(board, "_live", Mock())
        board.poll()
        shown = text(board.table())
    assert any(line.endswith("PSNR [dB] host / error") for line in shown)
    assert "1 running, 1 failed, 3 queued" in shown
    rows = [line for line in shown if line.startswith("as-full")]
    assert rows == [
        "as-full-seed2 running node7",
        "as-full-seed4 failed out of memory",
        "as-full-seed0 queued",
        "as-full-seed1 queued",
        "as-full-seed3 queued",
    ]


def test_running_cells_show_iterations_and_time_left_of_this_attempt(board, tmp_path, monkeypatch, capsys):
    def log(cell, *lines):
        (tmp_path / f"logs/{cell}.log").write_text("\n".join([*lines, ""]))
        (tmp_path / f"running/{cell}").write_text("node7")

    with monkeypatch.context() as patch, TrainingLogger(None, 12_000, 0) as training:
        for iteration, now in ((4250, 1000.0), (4300, 1020.0)):
            patch.setattr(logger.time, "monotonic", lambda now=now: now)
            training.report(Status(iteration, "stage1", 0.75, 21.5, {}, 12_345, 67))
    first, second = capsys.readouterr().out.splitlines()
    (tmp_path / "running").mkdir()
    (tmp_path / "logs").mkdir()
    monkeypatch.setattr(board, "_live", Mock())
    log("as-full-seed0", "node7: warpgs train --seed 0", first, second)
    log("as-full-seed1", "node7: warpgs train --seed 1", first)
    log("as-full-seed2", "node7: warpgs train --seed 2", second, "node8: warpgs train --resume as-full-seed2", "read")
    (tmp_path / "running/as-full-seed3").write_text("node7")  # and no log yet
    board.poll()
    rows = [line for line in text(board.table()) if line.startswith("as-full")]
    assert rows == [
        "as-full-seed0 running 4,300 / 12,000 0:51:20 node7",
        "as-full-seed1 running 4,250 / 12,000 node7",
        "as-full-seed2 running node7",
        "as-full-seed3 running node7",
        "as-full-seed4 queued",
    ]


def test_a_terminal_shows_the_table_from_the_start_and_the_progress_of_cells_while_they_run(tmp_path):
    for folder in ("running", "logs"):
        (tmp_path / folder).mkdir()
    line = "{}/12000 stage1  loss 0.7500  train PSNR 21.50  static 12,345  dynamic 67  2.5 it/s  0:51:20 left\n"
    with Terminal(SWEEP, str(tmp_path), columns=100) as terminal:
        terminal.read_until("1 queued")
        (tmp_path / "running/as-full-seed0").write_text("node7")
        for shown, iteration in (("4,250 / 12,000", 4250), ("4,300 / 12,000", 4300)):
            (tmp_path / "logs/as-full-seed0.log").write_text(line.format(iteration))
            terminal.read_until(shown)
        assert "0:51:20" in terminal.read_until("node7")
        (tmp_path / "end").touch()
        terminal.read_until("ended")


@pytest.mark.parametrize("columns", [60, 80])
def test_the_table_fits_the_terminal_with_one_line_per_cell(board, monkeypatch, columns):
    console = Console(file=io.StringIO(), width=columns, height=8)
    monkeypatch.setattr("warpgs.sweep.board.get_console", lambda: console)
    for seed in range(5):
        board.tell(Event(f"as-full-seed{seed}", "failed", "CUDA error: out of memory, " * 9))
    console.print(board.table())
    shown = console.file.getvalue().splitlines()
    assert len(shown) < 8
    assert all(len(line) <= columns for line in shown)
    assert sum("as-full" in line for line in shown) == 3
    assert "5 failed" in shown[0]


def test_brackets_are_shown_as_they_are(board):
    board.tell(Event("as-full-seed1", "failed", "file [/data/x] is [bold]bad"))
    shown = text(board.table())
    assert any("PSNR [dB]" in line for line in shown)
    assert "as-full-seed1 failed file [/data/x] is [bold]bad" in shown


def test_without_a_terminal_every_end_is_a_line(board, lines):
    board.tell(Event("as-full-seed1", "retried", "broken"))
    board.tell(Event("as-full-seed1", "failed", "broken still"))
    assert lines == ["[0/5] as-full-seed1 retried: broken", "[1/5] as-full-seed1 failed: broken still"]


def test_a_long_table_is_cut(board, monkeypatch):
    monkeypatch.setattr(module, "MAX_LINES", 2)
    assert len([line for line in text(board.table()) if line.startswith("as-full")]) == 2


def test_what_a_killed_sweep_left_running_is_forgotten(board, tmp_path):
    (tmp_path / "running").mkdir()
    (tmp_path / "running/as-full-seed0").write_text("node1")
    with board:
        assert list((tmp_path / "running").iterdir()) == []


@pytest.mark.parametrize(
    ("seconds", "total"),
    [(0.4, "1 second"), (20.5, "41 seconds"), (59.0, "2.0 minutes"), (1900.0, "1.06 hours"), (None, "0 seconds")],
)
def test_the_time_of_all_trainings_has_a_unit_of_its_size(board, seconds, total):
    board.metrics = {name: {"train_seconds": seconds} for name in ("as-full-seed0", "as-full-seed1")}
    assert notes_of(board)[0] == f"2 of 5 trainings finished, {total} of training in total."


def test_damaged_results_are_named_and_trained_again(board, tmp_path):
    (tmp_path / "as-full-seed0").mkdir()
    (tmp_path / "as-full-seed0/metrics.json").write_text("{")
    again = Board(tmp_path, board.cells, print)
    assert "metrics.json is not valid JSON" in again.errors["as-full-seed0"]
    assert "as-full-seed0" in [job.name for job in again.jobs("cpu")]
