"""What a sweep trains: a TOML file, or one of those that ship.

title = "Learning rates"
preset = "best"                          # a preset of warpgs train
seeds = 3                                # seeds 0, 1 and 2; a list names them
data = ["nerfds/as", "cup=other/cup"]    # captures, or folders of captures; NAME=PATH gives a name

[options]                                # of every training, as in warpgs train
iterations = 5_000

[variants.slow]
label = "half the rate"                  # in the tables; the variant's name if omitted
optim.networks = 4e-4

[variants.noisy]
query = "depth=network"                  # appended to the name of a built-in capture, after "?"
"""

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from warpgs.config import TrainConfig
from warpgs.config.bounds import MAX_VALUE
from warpgs.config.presets import PRESETS
from warpgs.errors import not_one_of, suggestion
from warpgs.files import read_bounded
from warpgs.parsed import parse_toml

from .options import file_of

MAX_BYTES = 1 << 20
"""Maximum size of a sweep's file [bytes]."""

MAX_SEEDS = 1000
MAX_NAME = 100
"""Maximum length of the name of a variant or capture [bytes]; a file's name has 255."""

RESERVED = ("data", "out", "resume", "preset", "seed", "device")
"""Options of a training that the sweep sets."""


@dataclass(frozen=True)
class Variant:
    """One line of the table.

    Attributes:
        name: Unique name, part of the names of run folders.
        label: What tables call it.
        options: Options of the training, nested as in ``TrainConfig``.
        query: Appended to the name of a built-in capture; may be empty.
    """

    name: str
    label: str
    options: Mapping[str, Any]
    query: str = ""


@dataclass(frozen=True)
class SweepSpec:
    """A sweep, as its file describes it.

    Attributes:
        source: The file, or the name of a sweep that ships, as it was given.
        title: Title of the tables.
        preset: Preset of every training.
        seeds: Seeds of every variant.
        data: Captures, as on the command line; may be empty.
        options: Options of every training, nested as in ``TrainConfig``; those of a variant come before them.
        variants: In the order of the table.
    """

    source: Path
    title: str
    preset: str
    seeds: tuple[int, ...]
    data: tuple[str, ...]
    options: Mapping[str, Any]
    variants: tuple[Variant, ...]

    @property
    def name(self) -> str:
        """Name of the file, without its ending."""
        return self.source.stem


def read_spec(name: str) -> SweepSpec:
    """A sweep that ships, by its name, or one from a TOML file.

    Raises:
        ValueError: If there is no such sweep, or its file is damaged or has unknown entries; the message names it.
    """
    path = file_of(name)
    return _parse(path, Path(name), parse_toml(path, read_bounded(path, MAX_BYTES)))


def _parse(path: Path, source: Path, values: dict[str, Any]) -> SweepSpec:
    _check_keys(f"{path}", values, ("title", "preset", "seeds", "data", "options", "variants"))
    preset = values.get("preset", "best")
    if preset not in list(PRESETS):  # TOML may give a list, which cannot be looked up in a dictionary
        raise ValueError(f"{path}: {not_one_of('preset', preset, PRESETS)}")
    variants = values.get("variants", {"full": {}})
    if not isinstance(variants, dict) or not variants:
        raise ValueError(f"{path}: variants must be tables, one for each line of the result")
    options = values.get("options", {})
    check_options(f"{path}: options", options)
    title, data = values.get("title", path.stem), values.get("data", [])
    if not isinstance(title, str):
        raise ValueError(f"{path}: title must be a text, got {reprlib.repr(title)}")
    if not isinstance(data, list) or not all(isinstance(item, str) for item in data):
        raise ValueError(f"{path}: data must be a list of captures, got {reprlib.repr(data)}")
    parsed = tuple(_variant(path, name, variant) for name, variant in variants.items())
    seeds = _seeds(path, values.get("seeds", 1))
    return SweepSpec(source, title, preset, seeds, tuple(data), options, parsed)


def check_name(where: str, name: str) -> None:
    """Refuses the name of a variant or capture that cannot be part of the name of a file.

    Args:
        where: Where the name was found, for the message.
        name: The name.

    Raises:
        ValueError: If it is empty, longer than ``MAX_NAME``, or has a character that file systems refuse.
    """
    shown = repr(name) if len(name) < 200 else f"{name[:200]!r}…"
    if not name.isprintable() or set(name) & set('/\\:*?"<>|') or not 0 < len(name.encode()) <= MAX_NAME:
        raise ValueError(
            f"{where}: {shown} cannot be a name: folders are named after it, so it must have 1 to {MAX_NAME} bytes, "
            'none of / \\ : * ? " < > |'
        )


def _variant(path: Path, name: str, values: Any) -> Variant:
    check_name(f"{path}: variants", name)
    where = f"{path}: variant {name}"
    if not isinstance(values, dict):
        raise ValueError(f"{where} must be a table, got {reprlib.repr(values)}")
    label, query = values.get("label", name), values.get("query", "")
    if not isinstance(label, str) or not isinstance(query, str):
        raise ValueError(f"{where}: label and query must be texts, got {reprlib.repr(label)} and {reprlib.repr(query)}")
    options = {key: value for key, value in values.items() if key not in ("label", "query")}
    check_options(where, options)
    return Variant(name, label, options, query)


def _seeds(path: Path, seeds: Any) -> tuple[int, ...]:
    chosen = list(range(min(seeds, MAX_SEEDS + 1))) if type(seeds) is int else seeds
    valid = isinstance(chosen, list) and all(type(seed) is int and 0 <= seed <= MAX_VALUE for seed in chosen)
    if not valid or not 0 < len(chosen) <= MAX_SEEDS or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"{path}: seeds must be a number of seeds (1 to {MAX_SEEDS}) or a list of different ones, "
            f"got {reprlib.repr(seeds)}"
        )
    return tuple(chosen)


def check_options(where: str, options: Any, cls: type = TrainConfig, prefix: str = "") -> None:
    """Refuses what ``TrainConfig`` has no field for, or what the sweep sets itself; types are checked later.

    Args:
        where: What the options belong to, for the message.
        options: Parsed TOML.
        cls: The dataclass that they are fields of.
        prefix: Names of the dataclasses around it, with dots.

    Raises:
        ValueError: If there is an unknown option; the message names it.
    """
    if not isinstance(options, dict):
        raise ValueError(f"{where}: {prefix.rstrip('.') or 'options'} must be a table, got {reprlib.repr(options)}")
    known = {field.name: field for field in fields(cls)}
    for name, value in options.items():
        if name not in known:
            from warpgs.runs.former import former_option  # imports torch, which the list of sweeps does not need

            close = former_option(f"{prefix}{name}") or suggestion(name, known, f"{prefix}{{}}".format)
            raise ValueError(f"{where}: there is no option {prefix}{name:.60}{close}")
        if not prefix and name in RESERVED:
            raise ValueError(f"{where}: {name} is not an option of one training: the sweep sets it")
        default = known[name].default_factory
        if isinstance(default, type) and is_dataclass(default):
            check_options(where, value, default, f"{prefix}{name}.")


def _check_keys(where: str, values: dict[str, Any], known: Sequence[str]) -> None:
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{where}: there is no entry {unknown[0]:.60}, expected {', '.join(known)}")
