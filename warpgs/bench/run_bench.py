"""``warpgs bench``: measures, prints the results as tables and writes them to files."""

import dataclasses
import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch

from warpgs.command_line.parsing import parse_size
from warpgs.files import write_json
from warpgs.ops.tiles import reset_budgets

from .measure import Measurements, measure
from .options import Bench
from .report import machine, print_machine, print_result, trace_events
from .scenes import SCENES, Views
from .trained_scenes import trained_views
from .training import bench_fps, bench_steps

SIZES = ("480x270", "1920x1080", "3840x2160")
"""Image sizes of trained scenes."""


def run_bench(options: Bench) -> list[Path]:
    """Measures scenes, or training steps and playback with ``--steps`` and ``--fps``; returns the files written.

    Raises:
        ValueError: If an option is not valid or not supported on this machine.
        ImportError: If the other renderer is not installed.
        OSError: If a file cannot be written.
    """
    device = options.device or ("cuda" if torch.cuda.is_available() else "cpu")
    options = dataclasses.replace(options, device=device)
    check(options)
    if options.steps or options.fps is not None:
        return bench_training(options, device)
    return bench(options, scenes_of(options, device), device)


def scenes_of(options: Bench, device: str) -> Iterator[Views]:
    """The scenes that the options ask for, made one after the other."""
    names: Sequence[str] = options.scenes
    if not names and not options.scene:
        names = tuple(SCENES) if device == "cuda" else ("small",)
    for name in names:
        yield SCENES[name].views(options.branches, device, options.sh_degree)
    for path in options.scene:
        yield from trained_views(path, sizes_of(options), device)


def sizes_of(options: Bench) -> list[tuple[int, int]]:
    """(width, height) of the images of trained scenes; raises ValueError as ``parse_size``."""
    texts = options.sizes or (SIZES if options.device == "cuda" else SIZES[:1])
    return [parse_size("--sizes", text) for text in texts]


def check(options: Bench) -> None:
    """Checks the options before anything is measured.

    Raises:
        ValueError: If an option is not valid or needs another device, or a file cannot be written.
        ImportError: If the other renderer is not installed.
    """
    if options.repeats < 1:
        raise ValueError(f"--repeats must be at least 1, got {options.repeats}")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda needs a CUDA GPU, found none")
    check_scenes(options)
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


def check_scenes(options: Bench) -> None:
    """Checks the options of random and of trained scenes; raises ValueError as ``check``."""
    _ = sizes_of(options)
    if options.sizes and not options.scene and options.fps is None:
        raise ValueError("--sizes is for --scene and --fps")
    if options.scene and (options.branches != "none" or options.sh_degree is not None):
        raise ValueError("--branches and --sh-degree are for random scenes: omit --scene")
    options.require_inputs()


def bench(options: Bench, scenes: Iterable[Views], device: str) -> list[Path]:
    """Measures scenes, prints the results and writes the files of ``--json`` and ``--profile``; returns their paths."""
    head = machine(device)
    print_machine(head)
    results, trace = [], []
    for scene in scenes:
        reset_budgets()  # of the previous scene
        result, kernels = measure(options, scene, device)
        print_result(result)
        results.append(result)
        trace += trace_events(scene.name, kernels, len(results))
    report = {"machine": head, "repeats": options.repeats, "results": results}
    return write((options.json, report), (options.profile, {"traceEvents": trace}))


def bench_training(options: Bench, device: str) -> list[Path]:
    """Measures training steps (``--steps``) and playback (``--fps``); returns the paths of the written files."""
    head = machine(device)
    print_machine(head)
    report: Measurements = {"machine": head, "repeats": options.repeats}
    if options.steps:
        report["steps"] = bench_steps(device, options.repeats, options.preset)
    if options.fps is not None:
        report["fps"] = bench_fps(options.fps, device, sizes_of(options) if options.sizes else ())
    return write((options.json, report))


def write(*files: tuple[Path | None, Measurements]) -> list[Path]:
    """Writes values as JSON to each path that is given; returns these paths."""
    written = []
    for path, values in files:
        if path is not None:
            write_json(path, values)
            written.append(path)
    return written
