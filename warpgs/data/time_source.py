"""Where the times of a capture come from, in words: its user must see whether they were given or guessed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

EVEN = 0.01
"""Time steps that differ by less than this fraction are called equal."""


@dataclass(frozen=True)
class TimeSource:
    """Where the times of a capture come from.

    Attributes:
        text: One clause, such as "times from the time stamps in the names, 0.4 s apart".
        problem: Why they may be wrong, another clause; empty if nothing suggests it.
    """

    text: str
    problem: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.problem}" if self.problem else self.text


AS_GIVEN = TimeSource("times as given")
"""Times of captures that are made in Python."""


def with_steps(text: str, times: Sequence[float], unit: str = "") -> str:
    """A clause on times, with the steps between them.

    Args:
        text: The clause.
        times: Times of all frames in any unit and order; several may be equal.
        unit: Their unit, with a space before it, such as " s" and " frames".
    """
    steps = np.diff(np.unique(np.asarray(times, np.float64)))
    if not len(steps):
        return f"{text}, all the same" if len(times) > 1 else text
    mean, largest = float(steps.mean()), float(steps.max())
    if largest - float(steps.min()) <= EVEN * mean:
        unit = " frame" if (mean, unit) == (1.0, " frames") else unit
        return f"{text}, {mean:.3g}{unit} apart"
    return f"{text}, {mean:.3g}{unit} apart on average, largest gap {largest:.3g}{unit}"
