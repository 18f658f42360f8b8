"""The status at the top of the panel: always of one height, so that no control moves when a text changes."""

import html
from collections.abc import Sequence

from warpgs.runs.trained import TrainedScene

LEAVES = "outside of what was filmed: what you see is guessed"
HIDDEN = "training cameras are hidden while you look through one"

LINES, NOTE_LINES = 3, 3
"""Number of lines about the image, and of lines of notes, which scroll if there are more."""

LINE_HEIGHT = 1.4
LINE_STYLE = "overflow: hidden; text-overflow: ellipsis; white-space: nowrap"
"""Height of a line [em], and the style of one about the image."""


def about(trained: TrainedScene, cost: str, rate: float) -> list[str]:
    """Lines about the image: numbers of Gaussians, the iteration, the resolution with its time, and the FPS."""
    static, dynamic = len(trained.scene.static), len(trained.scene.dynamic)
    counts = f"{static:,} static, {dynamic:,} dynamic Gaussians"
    return [counts, f"iteration {trained.metadata.iteration:,}", f"{cost}, {rate:.1f} FPS"]


def status_html(lines: Sequence[str], notes: Sequence[str]) -> str:
    """The status.

    Args:
        lines: At most ``LINES``; a long one is cut off, and shown whole under the pointer.
        notes: Texts below them, which wrap.
    """
    texts = [html.escape(" ".join(line.split())) for line in lines]
    rows = "".join(f'<div title="{text}" style="{LINE_STYLE}">{text}</div>' for text in texts)
    wrapped = "<br>".join(map(html.escape, notes))
    return (
        f'<div style="padding: 0 1em; font-size: 0.8em; line-height: {LINE_HEIGHT}">'
        f'<div style="height: {LINES * LINE_HEIGHT:g}em">{rows}</div>'
        f'<div style="height: {NOTE_LINES * LINE_HEIGHT:g}em; overflow: auto; color: orange">{wrapped}</div></div>'
    )
