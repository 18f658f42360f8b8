"""Line charts as SVG."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from markupsafe import Markup

from .templates import render

COLORS = ("#3b82f6", "#f97316", "#10b981", "#e11d48", "#8b5cf6", "#ca8a04", "#06b6d4", "#6b7280")
WIDTH, HEIGHT = 460, 230
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 26, 30
MAX_POINTS = 300
"""Maximum number of points of a curve; more are averaged."""

MAX_VALUES = 75
"""Maximum number of points of a curve whose values the page shows under the pointer; views show all."""


class Series(NamedTuple):
    """One curve of a chart; ``points`` are finite (x, y) in the order of x."""

    name: str
    color: str
    points: Sequence[tuple[float, float]]


def color_of(index: int) -> str:
    """The colour of a run."""
    return COLORS[index % len(COLORS)]


class Curve(NamedTuple):
    """A curve as drawn.

    Attributes:
        name, color: As of its series.
        line: (x, y) of its points [px].
        values: (x, y) of points that show their value under the pointer [px], and that value.
        is_marked: Whether these points are drawn.
    """

    name: str
    color: str
    line: list[tuple[float, float]]
    values: list[tuple[float, float, str]]
    is_marked: bool


def chart(title: str, x_name: str, series: Sequence[Series], dots: bool = False) -> Markup:
    """A chart as an SVG element; an empty string if no curve has a point."""
    averaged = [Series(s.name, s.color, _averaged(s.points)) for s in series if s.points]
    if not averaged:
        return Markup("")
    xs = [x for s in averaged for x, _ in s.points]
    ys = [y for s in averaged for _, y in s.points]
    x_range, y_range = (min(xs), max(xs)), _padded(min(ys), max(ys))
    return render(
        "chart.svg",
        title=title,
        x_name=x_name,
        width=WIDTH,
        height=HEIGHT,
        left=LEFT,
        right=WIDTH - RIGHT,
        x_ticks=[(_pixel_x(x, x_range), f"{x:.6g}") for x in _ticks(*x_range)],
        y_ticks=[(_pixel_y(y, y_range), f"{y:.4g}") for y in _ticks(*y_range)],
        curves=[_curve(s, x_range, y_range, dots) for s in averaged],
    )


def _curve(series: Series, x_range: tuple[float, float], y_range: tuple[float, float], dots: bool) -> Curve:
    line = [(_pixel_x(x, x_range), _pixel_y(y, y_range)) for x, y in series.points]
    is_marked = dots or len(line) == 1
    stride = 1 if is_marked else math.ceil(len(line) / MAX_VALUES)
    shown = list(zip(line, series.points, strict=True))[::stride]
    values = [(*at, f"{x:.6g}: {y:.5g}") for at, (x, y) in shown]
    return Curve(series.name, series.color, line, values, is_marked)


def _averaged(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most ``MAX_POINTS`` points: means of consecutive ones if there are more."""
    size = math.ceil(len(points) / MAX_POINTS)
    groups = [points[k : k + size] for k in range(0, len(points), size)]
    return [(sum(x for x, _ in g) / len(g), sum(y for _, y in g) / len(g)) for g in groups]


def _padded(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    """About five round numbers within a range."""
    span = (high - low) or 1.0
    step = 10.0 ** math.floor(math.log10(span / 5))
    step *= next(k for k in (1, 2, 5, 10) if span / (step * k) <= 6)
    first = math.ceil(low / step)
    return [k * step for k in range(first, first + 8) if k * step <= high + 1e-9 * span]


def _pixel_x(x: float, bounds: tuple[float, float]) -> float:
    return round(LEFT + (x - bounds[0]) / ((bounds[1] - bounds[0]) or 1.0) * (WIDTH - LEFT - RIGHT), 1)


def _pixel_y(y: float, bounds: tuple[float, float]) -> float:
    return round(HEIGHT - BOTTOM - (y - bounds[0]) / (bounds[1] - bounds[0]) * (HEIGHT - TOP - BOTTOM), 1)
