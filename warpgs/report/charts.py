"""Line charts as SVG."""

import html
import math
from collections.abc import Sequence
from typing import NamedTuple

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


def chart(title: str, x_name: str, series: Sequence[Series], dots: bool = False) -> str:
    """A chart as an SVG element; an empty string if no curve has a point."""
    curves = [Series(s.name, s.color, _averaged(s.points)) for s in series if s.points]
    if not curves:
        return ""
    xs = [x for s in curves for x, _ in s.points]
    ys = [y for s in curves for _, y in s.points]
    x_range, y_range = (min(xs), max(xs)), _padded(min(ys), max(ys))
    parts = [f'<text class="title" x="{LEFT}" y="16">{html.escape(title)}</text>']
    parts += [_y_tick(y, y_range) for y in _ticks(*y_range)]
    parts += [_x_tick(x, x_range) for x in _ticks(*x_range)]
    parts.append(
        f'<text class="tick" x="{WIDTH - RIGHT}" y="{HEIGHT - 2}" text-anchor="end">{html.escape(x_name)}</text>'
    )
    for s in curves:
        at = [(_pixel_x(x, x_range), _pixel_y(y, y_range)) for x, y in s.points]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
        parts.append(f'<polyline points="{line}" stroke="{s.color}"><title>{html.escape(s.name)}</title></polyline>')
        is_marked = dots or len(at) == 1
        stride = 1 if is_marked else math.ceil(len(at) / MAX_VALUES)
        for k in range(0, len(at), stride):
            (x, y), (x_value, y_value) = at[k], s.points[k]
            look = f'r="2.5" fill="{s.color}"' if is_marked else 'r="5" class="value"'
            value = f"{html.escape(s.name)}, {html.escape(x_name)} {x_value:.6g}: {y_value:.5g}"
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" {look}><title>{value}</title></circle>')
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">{"".join(parts)}</svg>'


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
    return LEFT + (x - bounds[0]) / ((bounds[1] - bounds[0]) or 1.0) * (WIDTH - LEFT - RIGHT)


def _pixel_y(y: float, bounds: tuple[float, float]) -> float:
    return HEIGHT - BOTTOM - (y - bounds[0]) / (bounds[1] - bounds[0]) * (HEIGHT - TOP - BOTTOM)


def _y_tick(y: float, bounds: tuple[float, float]) -> str:
    at = _pixel_y(y, bounds)
    line = f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
    return f'{line}<text class="tick" x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{y:.4g}</text>'


def _x_tick(x: float, bounds: tuple[float, float]) -> str:
    return f'<text class="tick" x="{_pixel_x(x, bounds):.1f}" y="{HEIGHT - 14}" text-anchor="middle">{x:.6g}</text>'
