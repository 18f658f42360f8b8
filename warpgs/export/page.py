"""One HTML file that plays a moving scene without a network: the numbers of ``baking``, compressed, and a player.

The player is in ``player/``: a page, its looks, two shaders, and two scripts, one of which sorts in a worker. The
numbers are in the page as elements ``<script type="application/gzip;base64">`` beside a JSON object that tells their
shapes; browsers do not run scripts of such a type.
"""

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any

from warpgs.files import write_bytes
from warpgs.progress import progress

from .baking import Baked, Bounds, Branch
from .packing import to_planes

VERSION = 1
MAX_KEYS = 256
"""Layers of a texture that every browser with WebGL2 has."""

MAX_GAUSSIANS = 1 << 22
"""Texels of 2048 rows of 2048: what every browser with WebGL2 has, a branch."""

ARRAYS = ("geometry", "colors", "rest")
PLACE = re.compile(r"\[\[([a-z.]+)\]\]")
"""Where the player's page takes another of its files, the title or the scene."""


@dataclass(frozen=True)
class Start:
    """How a page begins.

    Attributes:
        title: Of the page.
        size: (width, height) that ``intrinsics`` are for [px].
        intrinsics: fx, fy, cx, cy [px].
        viewmat: [4, 4] world to camera, where the viewer begins.
        pivot: Distance in front of the camera around which a viewer turns [scene units].
        track: One [4, 4] world to camera a key time, the filming camera's; may be empty.
        seconds: How long the scene plays.
        antialias: Whether opacities make up for the low-pass filter.
    """

    title: str
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    viewmat: list[list[float]]
    pivot: float
    track: list[list[list[float]]]
    seconds: float
    antialias: bool


def write_page(path: Path, baked: Baked, start: Start, quiet: bool = True) -> int:
    """Writes the page; returns its size [bytes].

    Raises:
        ValueError: If the scene has more key times or Gaussians than browsers can hold.
        OSError: If it can't be written; the message names the file.
    """
    branches = {"static": baked.static, "dynamic": baked.dynamic}
    check_size({name: len(branch) for name, branch in branches.items()}, baked.keys)
    facts = {
        "format": "warpgs page",
        "version": VERSION,
        "keys": baked.keys,
        "start": {field.name: getattr(start, field.name) for field in fields(start)},
        "branches": {name: _facts(branch) for name, branch in branches.items()},
    }
    blocks = [_block("application/json", "scene", json.dumps(facts, allow_nan=False).replace("<", "\\u003c"))]
    parts = [(name, array) for name in branches for array in ARRAYS]
    for name, array in progress(parts, "compressing", quiet):
        packed = gzip.compress(to_planes(getattr(branches[name], array)).tobytes(), 6, mtime=0)
        blocks.append(_block("application/gzip;base64", f"{name}-{array}", base64.b64encode(packed).decode()))
    return write_bytes(path, [_page(start.title, "\n".join(blocks)).encode()])


def check_size(counts: Mapping[str, int], keys: int) -> None:
    """Refuses what no browser can hold.

    Args:
        counts: Number of Gaussians of each branch.
        keys: Key times.

    Raises:
        ValueError: If there are too many.
    """
    if keys > MAX_KEYS:
        raise ValueError(f"a page holds at most {MAX_KEYS} key times, got {keys}")
    for name, count in counts.items():
        if count > MAX_GAUSSIANS:
            raise ValueError(f"a page holds at most {MAX_GAUSSIANS:,} {name} Gaussians, got {count:,}")


def _page(title: str, blocks: str) -> str:
    """The player with a scene in it."""
    folder = resources.files(__package__) / "player"
    given = {"title": html.escape(title), "scene": blocks}

    def part(place: re.Match[str]) -> str:
        name = place[1]
        return given[name] if name in given else (folder / name).read_text("utf-8")

    return PLACE.sub(part, (folder / "page.html").read_text("utf-8"))


def _block(kind: str, name: str, content: str) -> str:
    return f'<script type="{kind}" id="{name}">{content}</script>'


def _facts(branch: Branch) -> dict[str, Any]:
    shapes = {array: getattr(branch, array).shape for array in ARRAYS}
    return {"shapes": shapes, **{f.name: getattr(branch.bounds, f.name).tolist() for f in fields(Bounds)}}
