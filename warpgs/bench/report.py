"""What ``warpgs bench`` prints and writes."""

import importlib.metadata
import platform
import subprocess
from collections.abc import Iterable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.table import Table

from warpgs.runtime.profiling import KernelTime

WIDTH = 120
"""Columns of the output when it is not a terminal."""

CONTESTANTS = ("one_image", "three_images", "gsplat")


def machine(device: str) -> dict[str, Any]:
    """Where and with which versions the figures were measured."""
    if device == "cuda":
        hardware: dict[str, Any] = {"gpu": torch.cuda.get_device_name()}
    else:
        hardware = {"cpu": cpu_model(), "threads": torch.get_num_threads()}
    return {
        **hardware,
        "torch": torch.__version__,
        "warp": importlib.metadata.version("warp-lang"),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": commit(),
    }


def cpu_model() -> str:
    """The processor's name, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def commit() -> str | None:
    """The commit of the repository that this package lies in; None outside of one or without git."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def print_machine(head: dict[str, Any]) -> None:
    """Prints the machine on one line."""
    _console().print(", ".join(f"{name}: {value}" for name, value in head.items()), highlight=False, soft_wrap=True)


def print_result(result: dict[str, Any]) -> None:
    """Prints a table of a scene: one column for each renderer, one row for each figure."""
    console = _console()
    names = [name for name in CONTESTANTS if name in result]
    columns = [_flat(result[name]) for name in names]
    for name, column in zip(names, columns, strict=True):
        column |= {f"{k} over one_image": v for k, v in result["ratios_to_one_image"].get(name, {}).items()}
        if name == "gsplat":
            column |= {f"difference {k}": v for k, v in _flat(result["differences_from_gsplat"]).items()}
    title = (
        f"{result['name']}: {result['width']}x{result['height']}, {result['num_gaussians']:,} Gaussians, "
        f"{result['intersections']:,} intersections"
    )
    table = _titled(console, title)
    table.add_column("")
    for name in names:
        table.add_column(name, justify="right")
    for figure in dict.fromkeys(figure for column in columns for figure in column):
        table.add_row(figure, *("" if (value := c.get(figure)) is None else _text(value) for c in columns))
    console.print(table)


def print_rows(title: str, rows: list[dict[str, Any]]) -> None:
    """Prints a table with one line for each row; all rows have the same figures."""
    console = _console()
    table = _titled(console, title)
    for name in rows[0]:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(value if isinstance(value, str) else _text(value) for value in row.values()))
    console.print(table)


def trace_events(scene: str, kernels: Iterable[KernelTime], process: int) -> list[dict[str, Any]]:
    """A scene's kernels in the Trace Event Format [µs], as a process of their own."""
    common = {"pid": process, "tid": 0}
    title = {"name": "process_name", "ph": "M", "args": {"name": scene}, **common}
    return [
        title,
        *({"name": k.name, "ph": "X", "ts": k.start_ms * 1e3, "dur": k.duration_ms * 1e3, **common} for k in kernels),
    ]


def _console() -> Console:
    console = Console()
    return console if console.is_terminal else Console(width=WIDTH)


def _titled(console: Console, title: str) -> Table:
    """Prints a title on a line of its own, however wide the table that is to follow."""
    console.print(f"\n{title}", highlight=False, soft_wrap=True)
    return Table(box=box.SIMPLE if console.is_terminal else None)


def _flat(figures: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested figures with the names of the levels in one."""
    flat: dict[str, Any] = {}
    for name, value in figures.items():
        flat |= _flat(value, f"{prefix}{name} ") if isinstance(value, dict) else {prefix + name: value}
    return flat


def _text(value: int | float) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.3f}" if value >= 0.01 or value == 0 else f"{value:.2e}"
