"""Ranges of the numbers in a config, beside its fields."""

import reprlib
from dataclasses import dataclass
from typing import Any

from .fields import fields

MAX_VALUE = 10**15
"""Maximum of every number that has no smaller one."""


@dataclass(frozen=True)
class Bounds:
    """Range of a number in a config, as metadata of its type: ``depth: Annotated[int, Bounds(min=1)]``. Others
    have the default range.

    Attributes:
        min, max: Inclusive limits.
        positive: Whether 0 is excluded as well.
    """

    min: int = 0
    max: int | float = MAX_VALUE
    positive: bool = False

    def check(self, name: str, value: int | float) -> None:
        """Raises ValueError, naming the option, if the value is out of range or not a number."""
        if not value >= self.min:
            raise ValueError(f"{name} must be a number of at least {self.min}, got {value}")
        if value > self.max:
            raise ValueError(f"{name} must be a number of at most {self.max}, got {reprlib.repr(value)}")
        if self.positive and value == 0:
            raise ValueError(f"{name} must be positive, got 0")


def check_bounds(config: Any) -> None:
    """Checks every number of a dataclass, and of those inside, against the bounds beside its field.

    Raises:
        ValueError: If a number is out of its range; the message names it.
    """
    for name, hint, value in fields(config):
        if isinstance(value, int | float):
            bounds = (data for data in getattr(hint, "__metadata__", ()) if isinstance(data, Bounds))
            next(bounds, Bounds()).check(name, value)
