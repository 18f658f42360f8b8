"""The check of annotations while tests run."""

import functools
import inspect
from collections import Counter
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import beartype

MAX_CHECKED = 4
"""Number of times that a nested function is checked."""

_made: Counter[tuple[str, str]] = Counter()
_jaxtyped = jaxtyping.jaxtyped


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that checks its arguments and its result.

    Functions inside of functions are made anew at every call, and to generate the code of their checks takes a hundred
    times as long as to call them: only the first of each are checked.
    """
    name = function.__module__, function.__qualname__
    _made[name] += 1
    is_familiar = "<locals>" in name[1] and _made[name] > MAX_CHECKED
    return function if is_familiar else beartype(function)


def jaxtyped(function: Any = None, *, typechecker: Any = None) -> Any:
    """jaxtyping's decorator, which its import hook calls by name, without what it does to word its errors.

    It generates two functions for each that it checks, and binds all arguments at every call: that takes as long as
    a small training. Sizes of axes are compared within one call, as there.
    """
    if function is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if not inspect.isfunction(function) or inspect.isgeneratorfunction(function):
        return _jaxtyped(function, typechecker=typechecker)
    checked = typechecker(function)
    if checked is function:
        return function

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*arguments, **options)
        with _jaxtyped("context"):
            return checked(*arguments, **options)

    return call
