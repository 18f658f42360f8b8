"""Parsed JSON and TOML, with bounds on what no reader expects: deep nesting, huge integers, two values of one name."""

import json
import math
import re
import reprlib
import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_NESTING = 64
"""Maximum depth of objects and lists inside each other."""

MAX_INTEGER = 1 << 64
"""Maximum magnitude of an integer: larger ones do not fit into arrays, or into floating-point numbers at all."""

MAX_KEY_PARTS = 100
"""Maximum number of parts of a dotted key of TOML, whose parser takes time by its square."""

QUOTED = re.compile(r'"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'|#.*')
"""Strings and comments of TOML, which may have any number of dots."""


def parse_json(source: Path | str, data: bytes | str) -> dict[str, Any]:
    """The JSON object of a text.

    Args:
        source: Where the text comes from, for messages.
        data: The text.

    Raises:
        ValueError: If it is not JSON, holds something other than an object, or fails ``check_parsed``.
    """
    try:
        value = json.loads(data, object_pairs_hook=_distinct)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{source} is not valid JSON: {reason(error)}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{source} must hold a JSON object, got {type(value).__name__}")
    check_parsed(source, value)
    return value


def parse_toml(source: Path | str, data: bytes) -> dict[str, Any]:
    """The tables of a TOML text; arguments as for ``parse_json``.

    Raises:
        ValueError: If it is not TOML, has a key of more than ``MAX_KEY_PARTS`` parts, or fails ``check_parsed``.
    """
    try:
        text = data.decode()
        if any(line.count(".") > MAX_KEY_PARTS for line in QUOTED.sub("", text).split("\n")):
            raise ValueError(f"a key has more than {MAX_KEY_PARTS} parts")
        value = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{source} is not valid TOML: {reason(error)}") from error
    check_parsed(source, value)
    return value


def finite(values: Any) -> Any:
    """Values for JSON, in which numbers that are not finite are None."""
    if isinstance(values, float):
        return values if math.isfinite(values) else None
    if isinstance(values, dict):
        return {key: finite(value) for key, value in values.items()}
    return [finite(value) for value in values] if isinstance(values, list | tuple) else values


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        for name, value in pairs:
            if value != values[name]:
                raise ValueError(f"one object has {reprlib.repr(name)} twice, with different values")
    return values


def reason(error: Exception) -> str:
    """Why a parser of JSON or TOML refused a text, without advice for programmers."""
    if isinstance(error, RecursionError):
        return f"it is nested deeper than {MAX_NESTING} levels"
    return "an integer has thousands of digits" if "int_max_str_digits" in str(error) else str(error)


def check_parsed(source: Path | str, value: dict[str, Any]) -> None:
    """Refuses what no reader expects in parsed JSON or TOML.

    Args:
        source: Where it comes from, for messages.
        value: The parsed object.

    Raises:
        ValueError: If it is nested deeper than ``MAX_NESTING``, or has an integer larger than ``MAX_INTEGER``.
    """
    level: list[tuple[str, Any]] = [("", value)]
    for _ in range(MAX_NESTING):
        below: list[tuple[str, Any]] = []
        for name, outer in level:
            for key, inner in outer.items() if isinstance(outer, dict) else ((name, inner) for inner in outer):
                if isinstance(inner, dict | list):
                    below.append((key, inner))
                elif isinstance(inner, int) and abs(inner) > MAX_INTEGER:
                    number = reprlib.repr(inner)
                    raise ValueError(f"{source} is damaged: {key:.60} has more than 64 bits: {number}")
        level = below
    if level:
        raise ValueError(f"{source} is nested deeper than {MAX_NESTING} levels")
