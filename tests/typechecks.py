"""The check of annotations while tests run."""

from collections import Counter
from collections.abc import Callable
from typing import Any

from beartype import beartype

MAX_CHECKED = 4
"""Number of times that a nested function is checked."""

_made: Counter[tuple[str, str]] = Counter()


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that checks its arguments and its result.

    Functions inside of functions are made anew at every call, and to generate the code of their checks takes a hundred
    times as long as to call them: only the first of each are checked.
    """
    name = function.__module__, function.__qualname__
    _made[name] += 1
    is_familiar = "<locals>" in name[1] and _made[name] > MAX_CHECKED
    return function if is_familiar else beartype(function)
