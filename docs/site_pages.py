"""Fills in the generated parts of the site: the tables of options.md, from the dataclasses that commands parse."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from warpgs.cli import COMMANDS
from warpgs.command_line import Option, documented
from warpgs.config import TrainConfig
from warpgs.presets import PRESETS

MARKER = "<!-- options -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """mkdocs calls this for the text of every page."""
    return markdown.replace(MARKER, "\n".join(sections())) if MARKER in markdown else markdown


def sections() -> Iterator[str]:
    """The tables of all commands; those of ``train`` by group, followed by what its presets change."""
    for name, command in COMMANDS.items():
        options = command.load()
        yield f"## warpgs {name}\n\n{summary(options)}\n"
        groups: dict[str, list[Option]] = {}
        for option in documented(options):
            groups.setdefault(group_of(option.name), []).append(option)
        for group, members in groups.items():
            if group:
                yield f"### train --{group}.…\n\n{summary(type(getattr(PRESETS['paper'], group)))}\n"
            yield from table(("option", "default", "meaning"), [row(option) for option in members])
        if name == "train":
            yield "### What the presets change\n\nOptions that are not listed are the same in all presets.\n"
            yield from table(("option", *PRESETS), preset_rows())


def summary(options: type) -> str:
    """The docstring of a class in one paragraph."""
    return " ".join((options.__doc__ or "").replace("``", "`").split())


def group_of(name: str) -> str:
    """``model`` of ``--model.depth``, and of other options nothing."""
    return name.removeprefix("--").partition(".")[0] if "." in name else ""


def row(option: Option) -> tuple[str, ...]:
    """Name, default and meaning of an option; switches that are on are listed by how to turn them off."""
    if option.default is True:
        start, _, end = option.name.rpartition(".")
        name = f"{start}.no-{end}" if start else option.name.replace("--", "--no-", 1)
        return code(name), "on", option.text
    return code(f"{option.name} {option.metavar}".strip()), value_of(option.default), option.text


def value_of(value: Any) -> str:
    """A default as it is typed; nothing for what the text describes."""
    if value is None or value is dataclasses.MISSING or value == ():
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    return code(f"{value:g}" if isinstance(value, float) else str(value))


def preset_rows() -> list[tuple[str, ...]]:
    """Options that differ between the presets, with the value of each."""
    rows = []
    for option in documented(TrainConfig):
        names = option.name.removeprefix("--").replace("-", "_").split(".")
        values = [value(preset, names) for preset in PRESETS.values()]
        if names != ["preset"] and any(v != values[0] for v in values):
            rows.append((code(option.name), *(value_of(v) or "none" for v in values)))
    return rows


def value(config: Any, names: list[str]) -> Any:
    """A (nested) field of a config."""
    for name in names:
        config = getattr(config, name)
    return config


def code(text: str) -> str:
    """Text as code in a table."""
    return f"`{text}`"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    """A Markdown table."""
    yield f"| {' | '.join(head)} |\n|{'---|' * len(head)}"
    yield from (f"| {' | '.join(cells)} |" for cells in rows)
    yield ""
