"""Changes pages for the site: the tables of options.md come from the dataclasses that commands parse."""

import dataclasses
import functools
import re
from collections.abc import Iterator
from html import escape
from typing import Any

from warpgs.cli import COMMANDS
from warpgs.command_line.parsing import Option, documented
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS

MARKER = "<!-- options -->"

FILE_ONLY = re.compile(r"(<!-- (?:options|nothing) -->)\n.*?<!-- end -->\n?", re.DOTALL)
"""Text for readers of the file; the site has the tables of options, or nothing, there."""

ROW, CODE = re.compile(r"^\|.*$", re.MULTILINE), re.compile(r"`[^`]+`")

CELLS = {
    "long": re.compile(r"<td>(?=(?:(?!</td>).){60})"),
    "phrase": re.compile(r"<td>(?=(?:(?:<(?!/td>)[^>]*>)*[^<]){20})"),
}
"""Starts of cells of a table with at least 60 characters, then with at least 20 outside of tags, by their class."""

LONG_CODE, TEXT = re.compile(r"<code>(?=[^<]{44})"), re.compile(r">[^<]+<")

PATH = re.compile(r"(?<=<code>)(?<!</span><code>)[^<\s]{24,}(?=</code>)")
"""A long path in a sentence or table, not in a block of code."""

OPTION = re.compile(r"(?<![\w-])--?[A-Za-z][\w.-]*")

IMAGE = re.compile(r'(?<=<p>)<img [^>]*src="([^"]+)"[^>]*>(?=</p>)')

SHOWN = "best"
"""Preset whose values are the defaults of ``train`` in the tables: that of captures."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """mkdocs calls this for the text of every page."""
    filled = FILE_ONLY.sub(lambda note: "\n".join(sections()) if note[1] == MARKER else "", markdown)
    # GitHub needs pipes escaped also in the code of a table, where Python's Markdown shows the backslash.
    return ROW.sub(lambda row: CODE.sub(lambda code: code[0].replace("\\|", "|"), row[0]), filled)


def on_page_content(html: str, **_: Any) -> str:
    """mkdocs calls this for the HTML of every page; images become links to their files."""
    for name, start in CELLS.items():
        html = start.sub(f'<td class="{name}">', html)
    html = PATH.sub(lambda path: path[0].replace("/", "/<wbr>"), html)
    html = LONG_CODE.sub('<code class="long">', html)
    html = TEXT.sub(lambda text: OPTION.sub(r'<span class="option">\g<0></span>', text[0]), html)
    return IMAGE.sub(r'<a href="\1">\g<0></a>', html)


def sections() -> Iterator[str]:
    """The tables of all commands; those of ``train`` by group, followed by its presets."""
    for name, command in COMMANDS.items():
        yield f"## warpgs {name}\n\n{summary(command.load())}\n"
        if name == "train":
            yield f"Defaults are those of the preset `{SHOWN}`, which is the default for captures."
            yield "[Below](#presets) are those of the others.\n"
        groups: dict[str, list[Option]] = {}
        for option in options_of(name):
            groups.setdefault(group_of(option.name), []).append(option)
        for group, members in groups.items():
            if group:
                yield f"### train --{group}.*\n\n{summary(type(getattr(PRESETS[SHOWN], group)))}\n"
            yield from table(("option", "default", "meaning"), [row(option) for option in members])
        if name == "train":
            yield "### Presets\n\nOptions that are not listed are the same in all presets.\n"
            yield from table(("option", *PRESETS), preset_rows())


def options_of(command: str) -> Iterator[Option]:
    """The options of a command, with the defaults that it has on the command line."""
    for option in documented(COMMANDS[command].load()):
        yield option._replace(default=value(PRESETS[SHOWN], option.name)) if command == "train" else option


def summary(options: type) -> str:
    """The docstring of a class in one paragraph."""
    return " ".join((options.__doc__ or "").replace("``", "`").split())


def group_of(name: str) -> str:
    """``model`` of ``--model.depth``, and of other options nothing."""
    return name.removeprefix("--").partition(".")[0] if "." in name else ""


def row(option: Option) -> tuple[str, ...]:
    """Name, default and meaning of an option; switches have two names, as in the help."""
    name = f"{option.name} {option.metavar}".strip()
    if isinstance(option.default, bool):
        name += "," + re.sub(r"(.*\.|--)", r"\g<1>no-", option.name, count=1)
    # Lines of many choices and of two names break between them.
    return code(name.replace(",", "`, `")), value_of(option.default), escape(option.text, quote=False)


def value_of(value: Any) -> str:
    """A default as it is typed; nothing for what the text describes."""
    if value is None or value is dataclasses.MISSING or value == ():
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return code(f"{value:g}" if isinstance(value, float) else str(value))


def preset_rows() -> list[tuple[str, ...]]:
    """Options that differ between the presets, with the value of each."""
    rows = []
    for option in documented(TrainConfig):
        values = [value(preset, option.name) for preset in PRESETS.values()]
        if option.name != "--preset" and any(v != values[0] for v in values):
            rows.append((code(option.name), *(value_of(v) or "none" for v in values)))
    return rows


def value(config: TrainConfig, option: str) -> Any:
    """The value of an option, such as ``--model.depth``, in a config."""
    return functools.reduce(getattr, option.removeprefix("--").replace("-", "_").split("."), config)


def code(text: str) -> str:
    """Text as code in a table."""
    return f"`{text}`"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    """A Markdown table."""
    yield f"| {' | '.join(head)} |\n|{'---|' * len(head)}"
    yield from (f"| {' | '.join(cells)} |" for cells in rows)
    yield ""
