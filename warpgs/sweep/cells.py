"""The cells of a sweep: every variant on every capture with every seed, each a run folder of its own."""

import argparse
import dataclasses
import os
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from warpgs.config import TrainConfig, fields, scaled
from warpgs.config.builtin import is_builtin, parse_builtin
from warpgs.config.presets import PRESETS
from warpgs.errors import one_line, visible
from warpgs.runs.config_file import NAME as CONFIG_NAME
from warpgs.runs.config_file import parse_config

from .spec import SweepSpec, Variant, check_name

MAX_CELLS = 100_000

EVALUATION = ("lpips", "lpips_net")
"""Options of ``warpgs train`` and ``warpgs eval`` that change how a run is evaluated, not how it is trained."""


@dataclass(frozen=True)
class Cell:
    """One training of a sweep.

    Attributes:
        name: Unique name, and that of its run folder.
        scene: Name of the capture.
        variant: Name of the variant.
        config: What is trained; ``out`` is the run folder.
    """

    name: str
    scene: str
    variant: str
    config: TrainConfig

    @property
    def seed(self) -> int:
        return self.config.seed

    @property
    def folder(self) -> Path:
        assert self.config.out is not None
        return self.config.out

    @property
    def num_iterations(self) -> int:
        """Iterations of the whole run."""
        return scaled(self.config).schedule.num_iterations

    @property
    def command(self) -> str:
        """The command that trains it, for a shell."""
        return shlex.join(["warpgs", "train", *arguments(self.config)])


def find_scenes(data: Sequence[str], log: Callable[[str], object] = print, known: Iterable[str] = ()) -> dict[str, str]:
    """Captures by name, in order, also those that cannot be read (``find_problems``).

    Args:
        data: Captures, folders of captures, built-in captures ("builtin:studio"), or NAME=PATH.
        log: Receives a warning for each folder of captures with subfolders that are not captures.
        known: Captures of trainings that have finished: a folder also stands for those of them that were in it.

    Raises:
        ValueError: If there is none, or a name is wrong or given twice; the message names it.
    """
    if not data:
        raise ValueError("a sweep needs captures: give them with --data")
    scenes: dict[str, str] = {}
    for text in data:
        for name, path in _named(text, log, set(known) - set(scenes.values())):
            if name in scenes:
                raise ValueError(
                    f"two captures have the name {name}: {scenes[name]} and {path}; name one with --data NAME={path}"
                )
            scenes[name] = path
    return scenes


def _named(text: str, log: Callable[[str], object], known: Iterable[str]) -> Iterator[tuple[str, str]]:
    name, equals, rest = text.partition("=")
    if is_builtin(text):
        yield text.partition(":")[2].replace("?", "-").replace("=", "-").replace("&", "-"), text
    elif equals and not os.path.exists(text):
        check_name(f"there is no capture {text}", name)
        yield name, rest if is_builtin(rest) else str(Path(rest).resolve())
    else:
        root = Path(text).resolve()
        yield from ((path.name, str(path)) for path in _captures_in(root, log, known) or [root])


def _captures_in(root: Path, log: Callable[[str], object], known: Iterable[str]) -> list[Path]:
    """The captures in a folder, and those known that were there, by name; none if it is a capture itself.

    Says which other folders are in it.
    """
    from warpgs.data.loaders import is_capture  # imports torch

    captures = {path for path in map(Path, known) if path.parent == root}
    if not os.access(root, os.R_OK | os.X_OK) or not root.is_dir():
        return sorted(captures)
    if is_capture(root):
        return []
    folders = [path for path in sorted(root.iterdir()) if os.path.isdir(path)]
    captures |= {path for path in folders if os.access(path, os.R_OK | os.X_OK) and is_capture(path)}
    others = [path.name for path in folders if path not in captures and not path.name.startswith(".")]
    if captures and others:
        log(visible(f"warning: {root}: skipped folders that are not captures: {', '.join(others)}"))
    return sorted(captures)


def find_problems(scenes: Mapping[str, str]) -> dict[str, str]:
    """Why captures cannot be trained, in one line each, by name: no such folder, no capture, or not finished."""
    from warpgs.data.loaders import require_capture, require_finished  # imports torch

    problems = {}
    for name, path in scenes.items():
        if not is_builtin(path):
            try:
                require_finished(Path(path))
                require_capture(Path(path))
            except (ValueError, OSError) as error:
                problems[name] = one_line(error)
    return problems


def plan_cells(spec: SweepSpec, scenes: Mapping[str, str], out: Path, overrides: Mapping[str, Any]) -> list[Cell]:
    """Every cell of a sweep: variants within captures within seeds, so that whole tables come first.

    Options of every training in ``overrides`` precede those of the file.

    Raises:
        ValueError: If options do not fit together, or two cells have one name; the message names what is wrong.
    """
    if len(spec.seeds) * len(scenes) * len(spec.variants) > MAX_CELLS:
        raise ValueError(f"the sweep has more than {MAX_CELLS:,} cells")
    cells: dict[str, Cell] = {}
    for seed in spec.seeds:
        for scene, data in scenes.items():
            for variant in spec.variants:
                cell = _cell(spec, variant, scene, data, seed, out, overrides)
                if other := cells.get(cell.name):
                    raise ValueError(
                        f"two cells have the name {cell.name}: variant {other.variant} on {other.scene}, and variant "
                        f"{variant.name} on {scene}; rename one of them"
                    )
                cells[cell.name] = cell
    return list(cells.values())


def equal_variants(cells: Iterable[Cell]) -> list[list[str]]:
    """Names of those variants whose trainings of one capture are the same, in groups."""
    groups: dict[tuple[str, str], list[str]] = {}  # by the name of the capture: one folder may have two
    for cell in cells:
        key = cell.scene, repr(dataclasses.replace(cell.config, out=None))
        groups.setdefault(key, []).append(cell.variant)
    return [list(names) for names in dict.fromkeys(map(tuple, groups.values())) if len(names) > 1]


def _cell(
    spec: SweepSpec, variant: Variant, scene: str, data: str, seed: int, out: Path, overrides: Mapping[str, Any]
) -> Cell:
    where = f"{spec.source}: variant {variant.name}"
    if variant.query:
        if not is_builtin(data) or "?" in data:
            raise ValueError(f"{where} needs a plain built-in capture such as --data builtin:studio, got {data}")
        data = f"{data}?{variant.query}"
    if is_builtin(data):
        parse_builtin(data)
    options = dataclasses.asdict(PRESETS[spec.preset])
    options["assume"] = "masks"  # all cells of a table follow the masks, unless the sweep says otherwise
    for layer in (spec.options, variant.options, overrides):
        _update(options, layer)
    name = f"{scene}-{variant.name}-seed{seed}"
    config = parse_config(options, where)
    config = dataclasses.replace(config, data=Path(data), out=out / name, seed=seed)
    try:
        scaled(config)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return Cell(name, scene, variant.name, config)


def _update(options: dict[str, Any], layer: Mapping[str, Any]) -> None:
    for name, value in layer.items():
        if isinstance(value, dict):
            _update(options[name], value)
        else:
            options[name] = value


def arguments(config: TrainConfig) -> list[str]:
    """Arguments of ``warpgs train`` for a config: its preset, and every option that differs from it."""
    assert config.preset is not None
    first = ["--preset", config.preset]
    return [*first, *_different(config, PRESETS[config.preset])]


def evaluation_arguments(config: TrainConfig) -> list[str]:
    """Those of the arguments that say how the run is evaluated."""
    assert config.preset is not None
    plain = dataclasses.replace(config, **{name: getattr(PRESETS[config.preset], name) for name in EVALUATION})
    return list(_different(config, plain))


def parse_evaluation(command: str) -> tuple[dict[str, Any], list[str]]:
    """How a cell's command evaluates, as fields of its config, and the other words of the command."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    parser.add_argument("--lpips", type=Path)
    parser.add_argument("--lpips-net")
    found, words = parser.parse_known_args(shlex.split(command))
    return vars(found), words


def trained_captures(commands: Iterable[str]) -> list[str]:
    """The captures of cells, as the commands that train them say."""
    words = [shlex.split(command) for command in commands]
    return list(dict.fromkeys(word for line in words for name, word in pairwise(line) if name == "--data"))


def as_evaluated_before(cell: Cell, command: str, given: Collection[str]) -> Cell:
    """The cell, evaluated as its command of before says, but for the options that were given or that its file has.

    Another evaluation replaces the results: without this, it would drop LPIPS.
    """
    assert cell.config.preset is not None
    usual = PRESETS[cell.config.preset]
    before = {
        name: value
        for name, value in parse_evaluation(command)[0].items()
        if name not in given and getattr(cell.config, name) == getattr(usual, name)
    }
    return dataclasses.replace(cell, config=dataclasses.replace(cell.config, **before))


def _different(config: TrainConfig, default: TrainConfig) -> Iterator[str]:
    for (name, _, value), (*_, usual) in zip(fields(config), fields(default), strict=True):
        section, dot, last = name.replace("_", "-").rpartition(".")
        if value != usual:
            yield f"--{section}{dot}{'no-' if value is False else ''}{last}"
            if not isinstance(value, bool):
                yield from map(str, value if isinstance(value, tuple) else [value])


def finished_metrics(cell: Cell) -> dict[str, Any] | None:
    """The metrics of a cell that was trained to its end and evaluated; None if it was not.

    Raises:
        ValueError: If metrics.json is damaged; the message names it.
    """
    from warpgs.report.evaluated_run import read_metrics  # imports TensorBoard

    if not (cell.folder / "metrics.json").is_file():
        return None
    metrics = read_metrics(cell.folder)
    return metrics if metrics.get("iterations") == cell.num_iterations else None


def is_evaluated(cell: Cell, metrics: Mapping[str, Any]) -> bool:
    """Whether the metrics of a finished cell have what its config asks for."""
    return cell.config.lpips is None or metrics.get("lpips_net") == cell.config.lpips_net


def is_started(cell: Cell) -> bool:
    """Whether there is a run to continue."""
    return (cell.folder / CONFIG_NAME).is_file()
