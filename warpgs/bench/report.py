"""Tables, traces and machine data for the output of ``warpgs bench``."""

import importlib.metadata
from collections.abc import Iterable
from datetime import datetime, timezone
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from warpgs.evaluation.machine import commit, device_name
from warpgs.runtime.profiling import KernelTime

from .workloads import OTHERS

WIDTH = 120
"""Columns of the output when it is not a terminal."""

WORKLOADS = ("one_image", "three_images", *OTHERS)
"""Workloads in the order of their columns."""

NAMES = {
    "gpu": "GPU",
    "cpu": "CPU",
    "warp": "Warp",
    "fps": "FPS",
    "one_image": "one image",
    "three_images": "three images",
    "forward_backward_ms": "forward and backward [ms]",
    "forward_backward": "forward and backward",
    "one_thread_forward_backward_ms": "forward and backward, one thread [ms]",
    "one_thread_forward_backward": "forward and backward, one thread",
    "callable_forward_backward_ms": "forward and backward, graphed callable [ms]",
    "callable_forward_backward": "forward and backward, graphed callable",
    "graph_forward_ms": "forward, CUDA graph [ms]",
    "graph_forward": "forward, CUDA graph",
    "graph_forward_backward_ms": "forward and backward, CUDA graph [ms]",
    "graph_forward_backward": "forward and backward, CUDA graph",
    "stages_ms": "pass [ms]:",
    "project_fwd": "project, forward",
    "project_bwd": "project, backward",
    "composite_fwd": "composite, forward",
    "composite_bwd": "composite, backward",
    "ssim": "SSIM, forward and backward",
    "peak_memory_bytes": "peak memory [bytes]",
    "max_image": "of the image, largest",
    "mean_image": "of the image, mean",
    "visible_pixels": "of the image, visible pixels",
    "relative_gradients": "of gradients, relative:",
    "stage1_ms": "step of stage I [ms]",
    "stage2_ms": "step of stage II [ms]",
    "3dgs_ms": "step of 3DGS [ms]",
    "frames_per_second": "frames per second",
}
"""Names of keys in JSON; others are shown as they are, without underscores."""

UNITS = {"_ms": " [ms]", "_mb": " [MB]", "_bytes": " [bytes]"}
"""Units by the suffixes of keys in JSON."""


def machine(device: str) -> dict[str, Any]:
    """Hardware, versions, date and commit of the measurements."""
    name = device_name(torch.device(device))
    hardware = {"gpu": name} if device == "cuda" else {"cpu": name, "threads": torch.get_num_threads()}
    return {
        **hardware,
        "torch": torch.__version__,
        "warp": importlib.metadata.version("warp-lang"),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": commit(),
    }


def print_machine(head: dict[str, Any]) -> None:
    """Prints the result of ``machine`` on one line."""
    _console().print(
        ", ".join(f"{NAMES.get(name, name)}: {value}" for name, value in head.items()), highlight=False, soft_wrap=True
    )


def print_result(result: dict[str, Any]) -> None:
    """Prints a table of a scene with one column per workload and one row per measurement."""
    console = _console()
    names = [name for name in WORKLOADS if name in result]
    columns = [_flat(result[name]) for name in names]
    for name, column in zip(names, columns, strict=True):
        column |= {f"{_label(k)} over one image": v for k, v in result["ratios_to_one_image"].get(name, {}).items()}
        if name in OTHERS:
            column |= {f"difference {k}": v for k, v in _flat(result[f"differences_from_{name}"]).items()}
    title = (
        f"{result['name']}: {result['width']}x{result['height']}, {result['num_gaussians']:,} Gaussians, "
        f"{result['intersections']:,} intersections"
    )
    if result["sh_degree"] is not None:
        title += f", spherical harmonics of degree {result['sh_degree']}"
    if result["cameras"] > 1:
        title += f", {result['cameras']} cameras"
    table = _titled(console, f"{title}\n{_tail(result['intersections_per_tile'])}")
    table.add_column("")
    for name in names:
        table.add_column(_label(name), justify="right")
    for row in dict.fromkeys(row for column in columns for row in column):
        table.add_row(row, *("" if (value := c.get(row)) is None else _text(value) for c in columns))
    console.print(table)


def print_rows(title: str, rows: list[dict[str, Any]]) -> None:
    """Prints a table of rows, which all have the same keys."""
    console = _console()
    table = _titled(console, title)
    for name in rows[0]:
        table.add_column(_label(name), justify="right")
    for row in rows:
        table.add_row(*(escape(value) if isinstance(value, str) else _text(value) for value in row.values()))
    console.print(table)


def trace_events(scene: str, kernels: Iterable[KernelTime], process: int) -> list[dict[str, Any]]:
    """The kernels of a scene in the Trace Event Format [µs], as one process."""
    common = {"pid": process, "tid": 0}
    title = {"name": "process_name", "ph": "M", "args": {"name": scene}, **common}
    return [
        title,
        *({"name": k.name, "ph": "X", "ts": k.start_ms * 1e3, "dur": k.duration_ms * 1e3, **common} for k in kernels),
    ]


def _tail(tiles: dict[str, Any]) -> str:
    """How intersections spread over tiles, in one line."""
    return (
        f"intersections per tile: median {tiles['median']:,}, 99 % {tiles['99_percent']:,}, maximum "
        f"{tiles['maximum']:,}; the fullest 1 % of tiles have {tiles['share_of_fullest_1_percent']:.1%} of them"
    )


def _console() -> Console:
    console = Console()
    return console if console.is_terminal else Console(width=WIDTH)


def _titled(console: Console, title: str) -> Table:
    """Prints a title on one line, also if it is wider than its table; returns an empty table."""
    console.print(f"\n{title}", highlight=False, soft_wrap=True)
    return Table(box=box.SIMPLE if console.is_terminal else None)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flattens nested values; the labels of all levels are joined."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        label = prefix + _label(name)
        flat |= _flat(value, f"{label} ") if isinstance(value, dict) else {label: value}
    return flat


def _label(name: str) -> str:
    """The name of a JSON key, as rich markup: "forward [ms]" for "forward_ms"."""
    if name in NAMES:
        return escape(NAMES[name])
    for suffix, unit in UNITS.items():
        if name.endswith(suffix):
            name = name.removesuffix(suffix) + unit
    return escape(name.replace("_", " "))


def _text(value: int | float) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.3f}" if value >= 0.01 or value == 0 else f"{value:.2e}"
