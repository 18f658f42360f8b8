"""``warpgs sweep``: plan, train what is missing, write the tables."""

import dataclasses
import os
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from warpgs.command_line.screen import show_error
from warpgs.config.builtin import is_builtin
from warpgs.config.presets import PRESETS
from warpgs.errors import FAILED, not_one_of, one_line
from warpgs.evaluation.lpips import locate
from warpgs.files import read_json, write_json
from warpgs.locks import lock_folder
from warpgs.synthetic.folder import builtin_folder

from .board import Board
from .cells import (
    Cell,
    as_evaluated_before,
    equal_variants,
    find_problems,
    find_scenes,
    is_started,
    parse_evaluation,
    plan_cells,
    trained_captures,
)
from .options import Sweep
from .peers import read_peers
from .ray_pool import RayPool
from .results import show_tables, write_report, write_tables
from .scheduler import Event, Pool, run_jobs
from .shared_gpu import shared_gpus
from .spec import MAX_SEEDS, SweepSpec, read_spec
from .table import ALL_SCENES, Peers

INDEX = "sweep.json"
"""File in the folder of a sweep with the command of each cell, so that results of other options are never mixed in."""

INCOMPLETE = 1
"""Exit code if cells failed."""

Log = Callable[[str], None]


def run_sweep(options: Sweep, log: Log) -> int:
    """Trains what is missing, then prints and writes the tables; returns the exit code.

    Raises:
        ValueError: If options, the sweep's file or the plan are wrong, no capture can be trained and nothing has
            finished, or the folder holds another sweep's results.
        ImportError: If Ray is not installed.
        OSError: If a file cannot be written; tables that cannot be written have been printed.
        KeyboardInterrupt: After Ctrl-C or SIGTERM; the tables of what is finished are written.
    """
    spec = _spec(options)
    out = (options.out or Path("runs") / f"sweep-{spec.name}").resolve()
    # The output of a dry run is a script.
    warn = show_error if options.dry_run else log
    overrides, known = _overrides(options), _known_commands(out)
    finished = [command for name, command in known.items() if (out / name / "metrics.json").is_file()]
    scenes = find_scenes(spec.data, warn, trained_captures(finished))
    cells = [
        as_evaluated_before(cell, known.get(cell.name, ""), overrides)
        for cell in plan_cells(spec, scenes, out, overrides)
    ]
    peers = read_peers(options.compare) if options.compare else {}
    board = Board(out, cells, log)
    problems = _problems(options, board, scenes)
    for warning in (*_warnings(options, cells, peers, scenes), *problems.values()):
        warn(f"warning: {warning}")
    if options.dry_run:
        log("\n".join(cell.command for cell in cells))
        return 0
    if options.tables_only and not any(cell.name in known for cell in cells):
        raise ValueError(f"{out} has no training of this sweep: --tables-only needs the --out that it was started with")
    with lock_folder(out, "trained", (INDEX,)):
        if options.tables_only:
            board.recall()
        else:
            board.give_up(problems)
            for lpips, net in {(cell.config.lpips, cell.config.lpips_net) for cell in board.unfinished()}:
                locate(lpips, net)  # reports a wrong folder now, not in every cell
        _write_index(out, cells, known)
        return _run(options, spec, board, peers, log)


def _problems(options: Sweep, board: Board, scenes: Mapping[str, str]) -> dict[str, str]:
    """Why captures cannot be trained, of those that have cells to train; they fail these cells alone.

    Raises:
        ValueError: If there is nothing else to do.
    """
    if options.tables_only:
        return {}  # tables need no captures
    problems = find_problems(scenes)
    if len(problems) == len(scenes) and not board.metrics:
        raise ValueError(next(iter(problems.values())))
    needed = {cell.scene for cell in board.unfinished()}
    return {scene: problem for scene, problem in problems.items() if scene in needed}


def _warnings(options: Sweep, cells: list[Cell], peers: Peers, scenes: Mapping[str, str]) -> Iterator[str]:
    """What is probably not meant, though it can run."""
    if unknown := sorted({scene for numbers in peers.values() for scene in numbers} - {*scenes, ALL_SCENES}):
        yield f"{options.compare}: the sweep has no capture {', '.join(unknown)}, only {', '.join(scenes)}"
    for names in equal_variants(cells):
        yield f"variants with the same options, which train the same: {', '.join(names)}"


def _spec(options: Sweep) -> SweepSpec:
    """The sweep's file, changed by the command line."""
    spec = read_spec(options.sweep)
    if options.preset is not None and options.preset not in PRESETS:
        raise ValueError(not_one_of("--preset", options.preset, PRESETS))
    if options.tables_only and (options.lpips or options.lpips_net):
        raise ValueError("--tables-only evaluates nothing: omit --lpips and --lpips-net")
    for name in ("seeds", "per_gpu", "cpus"):
        value = getattr(options, name)
        if value is not None and not 1 <= value <= MAX_SEEDS:
            raise ValueError(f"--{name.replace('_', '-')} must be 1 to {MAX_SEEDS}, got {value}")
    return dataclasses.replace(
        spec,
        preset=options.preset or spec.preset,
        seeds=tuple(range(options.seeds)) if options.seeds else spec.seeds,
        data=options.data or spec.data,
    )


def _overrides(options: Sweep) -> dict[str, Any]:
    lpips = options.lpips or os.environ.get("WARPGS_LPIPS")  # which other nodes of a cluster do not have
    given = {
        "iterations": options.iterations,
        "factor": options.factor,
        "lpips": str(Path(lpips).resolve()) if lpips and not options.tables_only else None,
        "lpips_net": options.lpips_net,
    }
    return {name: value for name, value in given.items() if value is not None}


def _known_commands(out: Path) -> dict[str, str]:
    """The command of each cell when the sweep last started in this folder."""
    path = out / INDEX
    commands = read_json(path) if path.exists() else {}
    for name, value in commands.items():
        if not _is_command(value):
            raise ValueError(f"{path} is damaged: it has no command of {name:.100}")
    return commands


def _is_command(value: Any) -> bool:
    with suppress(ValueError):  # of quotes that do not end
        return isinstance(value, str) and bool(shlex.split(value))
    return False


def _write_index(out: Path, cells: list[Cell], known: dict[str, str]) -> None:
    """Writes the command of each cell; refuses a cell that was begun with another one."""
    for cell in cells:
        if is_started(cell) and parse_evaluation(known.get(cell.name, ""))[1] != parse_evaluation(cell.command)[1]:
            raise ValueError(
                f"{cell.folder} was trained with other options ({known.get(cell.name)}): choose another --out"
            )
    commands = {**known, **{cell.name: cell.command for cell in cells}}
    if commands != known:  # else the tables can be printed where the disk is full
        write_json(out / INDEX, commands)


def _run(options: Sweep, spec: SweepSpec, board: Board, peers: Peers, log: Log) -> int:
    code, stopped = 0, False
    with _pool(options, board, log) as pool:  # outside of the try: without it, the command is refused
        try:
            if pool is not None:
                _train(pool, spec, board, peers, log)
        except OSError as error:  # the cluster is gone, or there is no space for a built-in capture
            log(f"warpgs sweep: {one_line(error)}; the same command continues with what is missing")
            code = FAILED
        except KeyboardInterrupt:
            stopped = True
        if code or stopped:
            board.stop()
        # Before Ray ends, which takes seconds: a SIGKILL may soon follow the SIGTERM.
        show_tables(spec, board, peers, log)  # before they are written: the disk may be full
        try:
            write_tables(board.out, spec, board, peers)
            write_report(board.out, spec, board, peers)
            log(f"table.md, table.tex, table.csv, cells.csv and report.html are in {board.out}")
        except OSError as error:
            if not stopped:
                raise
            log(f"warpgs sweep: {one_line(error)}")
    if stopped:
        raise KeyboardInterrupt("stopped; the same command continues")
    return code or (INCOMPLETE if "failed" in board.states.values() else 0)


def _shares_local_gpus(options: Sweep) -> bool:
    """Whether trainings share GPUs of this machine; the nodes of a cluster start MPS themselves, or not at all."""
    if options.per_gpu == 1 or options.address is not None or options.device == "cpu":
        return False
    import torch

    return torch.cuda.device_count() > 0


@contextmanager
def _pool(options: Sweep, board: Board, log: Log) -> Iterator[Pool | None]:
    """Where cells are trained; None if there is nothing to do."""
    if options.tables_only or not board.unfinished():
        yield None
        return
    with shared_gpus(log) if _shares_local_gpus(options) else nullcontext():
        pool = RayPool(options.address, options.device, options.per_gpu, options.cpus)
        try:
            yield pool
        finally:
            pool.close()


def _train(pool: Pool, spec: SweepSpec, board: Board, peers: Peers, log: Log) -> None:
    def on_event(event: Event) -> None:
        board.tell(event)
        with suppress(OSError):  # a full disk, which is reported at the end, and stops no training that still runs
            write_tables(board.out, spec, board, peers)  # Ray may end this program

    for data in sorted({str(cell.config.data) for cell in board.unfinished() if is_builtin(str(cell.config.data))}):
        builtin_folder(data)  # once, not in every cell
    with board:
        run_jobs(pool, board.jobs(pool.device), on_event, board.poll, log)
