"""``warpgs bench``: measures what the options ask for, prints the results and writes them to files."""

import dataclasses
import importlib.util
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from warpgs.files import write_json
from warpgs.ops.tiles import reset_budgets

from .command import Bench
from .measure import Measurements, measure
from .report import machine, print_machine, print_result, trace_events
from .scenes import SCENES, Scene
from .training import bench_fps, bench_steps


def run_bench(options: Bench) -> None:
    """Measures scenes, or training steps and playback if the options ask for them.

    Raises:
        ValueError: If an option cannot be used on this machine.
        ImportError: If the other renderer is not installed.
        OSError: If a file cannot be written.
    """
    device = options.device or ("cuda" if torch.cuda.is_available() else "cpu")
    options = dataclasses.replace(options, device=device)
    check(options)
    if options.steps or options.fps is not None:
        bench_training(options, device)
        return
    names: Sequence[str] = options.scenes or (tuple(SCENES) if device == "cuda" else ("small",))
    bench(options, [SCENES[name] for name in names], device)


def check(options: Bench) -> None:
    """Refuses options that cannot be measured on this machine, before time is spent on them.

    Raises:
        ValueError: If an option needs another device, or a file cannot be written.
        ImportError: If the other renderer is not installed.
    """
    if options.repeats < 1:
        raise ValueError(f"--repeats must be at least 1, got {options.repeats}")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda needs a CUDA GPU, found none")
    for option, given in (("--graph", options.graph), (f"--against {options.against}", options.against)):
        if given and options.device != "cuda":
            raise ValueError(f"{option} needs --device cuda")
    if options.against and importlib.util.find_spec(options.against) is None:
        raise ImportError(f"--against {options.against} needs the package {options.against}")
    for path in (options.json, options.profile):
        if path is not None and not path.absolute().parent.is_dir():
            raise ValueError(f"cannot write {path}: no such folder")
        if path is not None and path.is_dir():
            raise ValueError(f"cannot write {path}: it is a folder")


def bench(options: Bench, scenes: Iterable[Scene], device: str) -> None:
    """Measures scenes, prints the results and writes the files of ``--json`` and ``--profile``."""
    head = machine(device)
    print_machine(head)
    results, trace = [], []
    for scene in scenes:
        reset_budgets()  # of the previous scene
        result, kernels = measure(options, scene, device)
        print_result(result)
        results.append(result)
        trace += trace_events(scene.name, kernels, len(results))
    if options.json is not None:
        write(options.json, {"machine": head, "repeats": options.repeats, "results": results})
    if options.profile is not None:
        write(options.profile, {"traceEvents": trace})


def bench_training(options: Bench, device: str) -> None:
    """Measures whole training steps (``--steps``) and playback of a run (``--fps``)."""
    head = machine(device)
    print_machine(head)
    report: Measurements = {"machine": head, "repeats": options.repeats}
    if options.steps:
        report["steps"] = bench_steps(device, options.repeats)
    if options.fps is not None:
        report["fps"] = bench_fps(options.fps, device)
    if options.json is not None:
        write(options.json, report)


def write(path: Path, values: dict[str, Any]) -> None:
    """Writes measurements or a trace, and prints the path."""
    write_json(path, values)
    print(f"wrote {path}")
