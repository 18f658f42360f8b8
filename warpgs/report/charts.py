"""Curves as SVG."""

import html
import math
from collections.abc import Sequence
from typing import NamedTuple

COLORS = ("#3b82f6", "#f97316", "#10b981", "#e11d48", "#8b5cf6", "#ca8a04", "#06b6d4", "#6b7280")
WIDTH, HEIGHT = 460, 230
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 26, 30
MAX_POINTS = 300
"""Of a curve; more are averaged."""


class Series(NamedTuple):
    """One curve of a chart; ``points`` are (x, y) in order of x, all finite."""

    name: str
    color: str
    points: Sequence[tuple[float, float]]


def color_of(number: int) -> str:
    """The colour of a run."""
    return COLORS[number % len(COLORS)]


def chart(title: str, x_name: str, series: Sequence[Series], dots: bool = False) -> str:
    """A chart; an empty text if no curve has a point.

    Args:
        title: Above it.
        x_name: Below it.
        series: Curves.
        dots: Whether points are drawn, too.
    """
    drawn = [Series(s.name, s.color, _thinned(s.points)) for s in series if s.points]
    if not drawn:
        return ""
    xs = [x for s in drawn for x, _ in s.points]
    ys = [y for s in drawn for _, y in s.points]
    x_range, y_range = (min(xs), max(xs)), _padded(min(ys), max(ys))
    parts = [f'<text class="title" x="{LEFT}" y="16">{html.escape(title)}</text>']
    parts += [_y_tick(y, y_range) for y in _ticks(*y_range)]
    parts += [_x_tick(x, x_range) for x in _ticks(*x_range)]
    parts.append(
        f'<text class="tick" x="{WIDTH - RIGHT}" y="{HEIGHT - 2}" text-anchor="end">{html.escape(x_name)}</text>'
    )
    for s in drawn:
        at = [(_place_x(x, x_range), _place_y(y, y_range)) for x, y in s.points]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
        parts.append(f'<polyline points="{line}" stroke="{s.color}"><title>{html.escape(s.name)}</title></polyline>')
        if dots or len(at) == 1:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{s.color}"/>' for x, y in at]
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">{"".join(parts)}</svg>'


def _thinned(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Means of neighbours, where there are more points than can be seen."""
    size = math.ceil(len(points) / MAX_POINTS)
    groups = [points[k : k + size] for k in range(0, len(points), size)]
    return [(sum(x for x, _ in g) / len(g), sum(y for _, y in g) / len(g)) for g in groups]


def _padded(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers within a range, about five of them."""
    span = (high - low) or 1.0
    step = 10.0 ** math.floor(math.log10(span / 5))
    step *= next(k for k in (1, 2, 5, 10) if span / (step * k) <= 6)
    first = math.ceil(low / step)
    return [k * step for k in range(first, first + 8) if k * step <= high + 1e-9 * span]


def _place_x(x: float, bounds: tuple[float, float]) -> float:
    return LEFT + (x - bounds[0]) / ((bounds[1] - bounds[0]) or 1.0) * (WIDTH - LEFT - RIGHT)


def _place_y(y: float, bounds: tuple[float, float]) -> float:
    return HEIGHT - BOTTOM - (y - bounds[0]) / (bounds[1] - bounds[0]) * (HEIGHT - TOP - BOTTOM)


def _y_tick(y: float, bounds: tuple[float, float]) -> str:
    at = _place_y(y, bounds)
    line = f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
    return f'{line}<text class="tick" x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{y:.4g}</text>'


def _x_tick(x: float, bounds: tuple[float, float]) -> str:
    return f'<text class="tick" x="{_place_x(x, bounds):.1f}" y="{HEIGHT - 14}" text-anchor="middle">{x:.6g}</text>'
