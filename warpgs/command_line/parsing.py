"""Parsing of command lines by tyro, with help that fits the screen and errors in one line.

Help texts are the docstrings of fields. Tyro keeps their line breaks, which are those of the source, and shows
``{None}|PATH`` and ``(default: None)`` for what may be omitted; here they are rewrapped, and shown without.
"""

import ast
import contextlib
import dataclasses
import inspect
import io
import re
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import tyro

from warpgs.errors import not_one_of, suggestion

from .screen import Stream, is_terminal, wrapped

Options = TypeVar("Options")

RunFolder = Annotated[Path, tyro.conf.arg(name="run", metavar="RUN"), tyro.conf.Positional]
"""A positional argument: the folder of a run."""

MAX_SIDE = 16_384
"""Maximum width and height of an image [px]."""

METAVARS: dict[Any, str] = {int: "INT", float: "FLOAT", str: "NAME", Path: "PATH"}


def parse_size(option: str, text: str) -> tuple[int, int]:
    """(width, height) of the value of an option [px].

    Raises:
        ValueError: If it does not have the form WIDTHxHEIGHT, or is out of range; the message names the option.
    """
    numbers = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    width, height = (int(number) for number in numbers.groups()) if numbers else (0, 0)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ValueError(f"{option} must be WIDTHxHEIGHT with sides of 1 to {MAX_SIDE:,} pixels, got {text!r}")
    return width, height


def _choices(match: re.Match[str]) -> str:
    """One message for those of tyro and of argparse, which quotes the choices in some versions of Python."""
    choices = sorted({choice.strip(" '") for choice in match["choices"].split(",")} - {"None", ""})
    groups = match.groupdict()
    given = ast.literal_eval(groups["literal"]) if "literal" in groups else groups["given"]
    return not_one_of(match["option"], given, choices)


def _of_types(match: re.Match[str]) -> str:
    """What the values of an option of several had to be, in the words of ``METAVARS``."""
    names = {kind.__name__: shown for kind, shown in METAVARS.items()}
    return f"expected {' '.join(names.get(kind, kind) for kind in match[2].split(', '))}, got {match[1]}"


EMPTY_ROW = re.compile(r"^(?:\x1b\[[0-9;]*m|[│| ])*│(?:\x1b\[[0-9;]*m)*\n", re.MULTILINE)
"""A row of tyro's boxes without text, which follows one that is full."""

ALWAYS = ("--help", "--help-all", "--version")
"""Options of every command that are not fields of its dataclass."""

REWORDED: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"invalid literal for int\(\) with base 10: (.*)", r"expected INT, got \1"),
    (r"could not convert string to float: (.*)", r"expected FLOAT, got \1"),
    (r"^Missing from [^:]*: ", "missing: "),
    (r"([A-Z]{2,}) (?:(?!\(required\)).)*\(required\)", r"\1"),
    (
        r"^invalid choice '(?P<given>.*)' for argument '(?P<option>\S+)'\. Expected one of \((?P<choices>.*)\)\.$",
        _choices,
    ),
    (
        r"""^argument (?P<option>\S+): invalid choice: (?P<literal>'.*'|".*") \(choose from (?P<choices>.*)\)$""",
        _choices,
    ),
    (r"Could not parse arguments \[(.*)\] into tuple type tuple\[(.*)\]", _of_types),
    (r"^Missing value for argument '(\S+?)'.*", r"missing value for \1"),
    (
        r"no type matching \{([^{}A-Z]+)\}\|\{([A-Z ]+)\} could be instantiated from \[(.*?)\]\..*",
        lambda match: f"expected {', '.join(match[1].replace(',', ' ').split())} or {match[2]}, got {match[3]}",
    ),
    (r"Could not find valid parse for arguments: \[(.*)\]", r"no value is written as \1"),
    (
        r"no type matching \{None\}\|\{?([A-Z ]+?)\}? could be instantiated from \[(.*?)\]\..*",
        r"expected \1, got \2",
    ),
)
"""Parts of tyro's messages and what is said instead."""


def parse(options: type[Options], arguments: Sequence[str], prog: str) -> Options:
    """The options of a command line.

    Raises:
        ValueError: If an option is wrong.
        SystemExit: After ``--help``.
    """
    # Help is of the whole command: tyro leaves out the positional arguments that are given.
    rest = ["--help"] if {"-h", "--help"} & {*arguments} else _with_values(options, arguments)
    with one_line_errors(options, arguments, prog), described(options):
        return tyro.cli(options, args=rest, prog=prog)


def _with_values(options: type, arguments: Sequence[str]) -> list[str]:
    """The arguments, with a value after each switch that is neither on nor off unless given, as tyro expects it."""
    on = {f"--{name}" for name in open_switches(options)}
    off = {f"--no-{name[2:]}": name for name in on}
    values = []
    for argument in arguments:
        name = argument.replace("_", "-")
        values += [name, "True"] if name in on else [off[name], "False"] if name in off else [argument]
    return values


def open_switches(options: type) -> Iterator[str]:
    """Names on the command line of the fields ``bool | None``, without prefixes."""
    for name, hint in typing.get_type_hints(options, include_extras=True).items():
        plain = _plain(hint)
        if dataclasses.is_dataclass(plain):
            yield from open_switches(typing.cast(type, plain))
        elif _is_open_switch(hint):
            yield _shown(name, hint)


@contextlib.contextmanager
def one_line_errors(
    options: type, arguments: Sequence[str], prog: str, former: Callable[[str], str] = lambda name: ""
) -> Iterator[None]:
    """Refuses options that do not exist, and turns tyro's boxes about other wrong options into errors of one line.

    Args:
        options: A dataclass of options.
        arguments: The command line.
        prog: The program and its command.
        former: Says what became of an option of earlier versions; empty if there never was one of that name.

    Raises:
        ValueError: If an option is wrong.
    """
    known = {*flags(options), *ALWAYS}
    for argument in arguments:
        name = argument.split("=")[0].replace("_", "-")
        if name.startswith("--") and name not in known and not name.startswith("--tyro"):
            # Without the dashes, which would make all short options similar.
            close = former(name) or suggestion(name[2:], [option[2:] for option in known], "--{}".format)
            raise ValueError(f"there is no option {name}{close or f'; {prog} --help lists all'}")
    box, text = io.StringIO(), _Like(sys.stdout)
    try:
        with contextlib.redirect_stderr(box), contextlib.redirect_stdout(text):
            yield
    except SystemExit as end:
        if end.code:
            raise ValueError(_with_places(options, _unboxed(box.getvalue()))) from None
        help_text = EMPTY_ROW.sub("", text.getvalue())
        sys.stdout.write(wrapped(help_text))  # tyro wraps its boxes, but not what precedes them
        raise
    sys.stderr.write(box.getvalue())


class _Like(io.StringIO):
    """A file in memory with the encoding of another one, and a terminal if that is one: tyro looks at both."""

    def __init__(self, other: Stream) -> None:
        super().__init__()
        self._other = other

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._other, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        return is_terminal(self._other)


def _unboxed(text: str) -> str:
    """The first paragraph of tyro's message without its box, or argparse's message without its usage, in one line."""
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip("│ ") for line in text.splitlines()]
    lines = [line for line in lines if line and line[0] not in "╭╰"]
    rules = [k for k, line in enumerate(lines) if not line.strip("─-")]
    if rules[:1] == [1] and "│" not in text:  # below the title of a box without Unicode
        lines, rules = lines[2:], [k - 2 for k in rules[1:]]
    message = " ".join(" ".join(lines[: rules[0] if rules else None]).split()).split(" error: ")[-1]
    for pattern, replacement in REWORDED:
        message = re.sub(pattern, replacement, message)
    return message[:1].lower() + message[1:]


def _with_places(options: type, message: str) -> str:
    """A message about an option of several values with what its help calls them: NAME TIME."""
    found = re.fullmatch(r"(?:missing value for|error parsing) (--\S+?)(?:: expected ([A-Z ]+), got (.*))?", message)
    metavars = {option.name: option.metavar.split() for option in documented(options)} if found else {}
    if not found or len(places := metavars.get(found[1], [])) < 2:
        return message
    needs = f"{found[1]} needs {len(places)} values, {' '.join(places)}"
    types, given = (found[2] or "").split(), [text.strip("'\"") for text in (found[3] or "").split(", ")]
    if len(types) != len(places) or len(given) != len(places):
        return f"{needs}; got {' '.join(given) or 'fewer'}"
    wrong = (k for k, kind in enumerate(types) if kind in ("INT", "FLOAT") and not _is_number(given[k]))
    return next((f"{needs}, of which {places[k]} is a number; got {given[k]}" for k in wrong), message)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def flags(options: type, prefix: str = "") -> Iterator[str]:
    """All options of a dataclass of options: ``--out``, ``--no-graph``, ``--model.depth`` …"""
    for name, hint in typing.get_type_hints(options, include_extras=True).items():
        shown, plain = _shown(name, hint), _plain(hint)
        if _is_hidden(hint):
            continue
        if dataclasses.is_dataclass(plain):
            yield from flags(typing.cast(type, plain), f"{prefix}{shown}." if shown else prefix)
            continue
        yield f"--{prefix}{shown}"
        if plain is bool:
            yield f"--{prefix}no-{shown}"


class Option(NamedTuple):
    """An option for documentation.

    Attributes:
        name: As it is typed: ``--model.depth``; of a positional argument what it is: ``RUN``.
        metavar: What the value is; empty for a switch.
        default: Default value; ``dataclasses.MISSING`` without one.
        text: What it does.
    """

    name: str
    metavar: str
    default: Any
    text: str


def documented(options: type, prefix: str = "") -> Iterator[Option]:
    """All options of a dataclass of options and of those inside it, with their defaults and docstrings."""
    hints, texts = typing.get_type_hints(options, include_extras=True), docstrings(options)
    for field in dataclasses.fields(options):
        hint = hints[field.name]
        settings, shown, plain = _settings(hint), _shown(field.name, hint), _plain(hint)
        if _is_hidden(hint):
            continue
        if dataclasses.is_dataclass(plain):
            yield from documented(typing.cast(type, plain), f"{prefix}{shown}." if shown else prefix)
            continue
        metavar = (settings.metavar if settings else None) or _metavar(plain) or _repeated(plain)
        is_positional = tyro.conf.Positional in getattr(hint, "__metadata__", ())
        name = metavar if is_positional else f"--{prefix}{shown}"
        yield Option(name, "" if is_positional or plain is bool else metavar, field.default, texts.get(field.name, ""))


@contextlib.contextmanager
def described(options: type, shown: Collection[str] | None = None) -> Iterator[None]:
    """While it lasts, tyro shows rewrapped help of a dataclass of options and of those inside it.

    Args:
        options: The dataclass; its annotations and its docstring are replaced, and restored afterwards.
        shown: Names of the fields to show; all if None. The others are accepted, but not shown.
    """
    hints = typing.get_type_hints(options, include_extras=True)
    before, texts, docstring = dict(options.__annotations__), docstrings(options), options.__doc__ or ""
    with contextlib.ExitStack() as stack:
        stack.callback(lambda: setattr(options, "__annotations__", before))
        stack.callback(lambda: setattr(options, "__doc__", docstring))
        options.__doc__ = docstring.replace("``", "")
        for name in before:
            hint, plain = hints[name], _plain(hints[name])
            if shown is not None and name not in shown:
                options.__annotations__[name] = Annotated[hint, tyro.conf.Suppress]
            elif dataclasses.is_dataclass(plain):
                stack.enter_context(described(typing.cast(type, plain)))
            else:
                options.__annotations__[name] = _with_help(name, hint, texts.get(name, ""))
        yield


def docstrings(options: type) -> dict[str, str]:
    """The docstring below each field of a dataclass, without line breaks and marks of code."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(options))).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, text in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            texts[ast.unparse(field.target)] = " ".join(str(text.value.value).replace("``", "").split())
    return texts


def _with_help(field: str, hint: Any, text: str) -> Any:
    given, settings = _settings(hint), dict[str, Any](help=text)
    settings["name"], metavar = (given.name, given.metavar) if given else (None, None)
    settings["metavar"] = metavar or _metavar(_plain(hint))
    settings["help_behavior_hint"] = "" if "the default is" in text else _default_hint
    if _is_open_switch(hint):  # shown as other switches are: tyro names aliases first
        shown = _shown(field, hint)
        settings |= {"metavar": "", "name": f"no-{shown}", "aliases": (f"--{shown}",)}
        settings["help_behavior_hint"] = "(default: no)"
    return Annotated[hint, tyro.conf.arg(**settings)]


def _metavar(plain: Any) -> str | None:
    if typing.get_origin(plain) is typing.Literal:
        return "{" + ",".join(map(str, typing.get_args(plain))) + "}"
    if typing.get_origin(plain) is tuple and ... not in typing.get_args(plain):
        return " ".join(_metavar(part) or "VALUE" for part in typing.get_args(plain))
    return METAVARS.get(plain)


def _repeated(plain: Any) -> str:
    """The metavar of a tuple, from that of its first part."""
    parts = typing.get_args(plain)
    return f"{_metavar(parts[0]) or 'VALUE'} …" if parts else "VALUE"


def _default_hint(default: str) -> str:
    """What follows the help of an option; many defaults are described by the help itself."""
    shown = {"None": "", "True": "yes", "False": "no"}.get(default, default)
    return f"(default: {shown})" if shown else ""


def _settings(hint: Any) -> Any:
    """What ``tyro.conf.arg`` says in an annotation; None without it."""
    return next((data for data in getattr(hint, "__metadata__", ()) if hasattr(data, "help_behavior_hint")), None)


def _shown(name: str, hint: Any) -> str:
    """The name of a field on the command line; empty for a dataclass whose options have no prefix."""
    settings = _settings(hint)
    return name.replace("_", "-") if settings is None or settings.name is None else settings.name


def _is_open_switch(hint: Any) -> bool:
    """Whether an annotation is ``bool | None``: a switch that is neither on nor off unless given."""
    return bool(hint == (bool | None))


def _is_hidden(hint: Any) -> bool:
    """Whether a field is not an option, although its dataclass is of options."""
    return tyro.conf.Fixed in getattr(hint, "__metadata__", ())


def _plain(hint: Any) -> Any:
    """The type of an annotation without its metadata and ``| None``."""
    if hasattr(hint, "__metadata__"):
        return _plain(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        others = [part for part in typing.get_args(hint) if part is not type(None)]
        return _plain(others[0]) if len(others) == 1 else hint
    return hint
