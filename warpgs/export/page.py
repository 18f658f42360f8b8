"""One HTML file that plays a moving scene without a network: the numbers of ``baking``, compressed, and a player.

The player is in ``player/``: a page, its looks, two shaders, and two scripts, one of which sorts in a worker. The
numbers are in the page as elements ``<script type="application/gzip;base64">`` beside a JSON object that tells their
shapes; browsers do not run scripts of such a type.
"""

import base64
import binascii
import gzip
import html
import json
import re
import zlib
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.progress import progress

from .baking import WORDS, Baked, Bounds, Branch
from .files import read_bounded, write_whole
from .packing import from_planes, to_planes

VERSION = 1
LARGEST_PAGE = 2 << 30
MOST_KEYS = 256
"""Layers of a texture that every browser with WebGL2 has."""

MOST_GAUSSIANS = 1 << 22
"""Texels of 2048 rows of 2048: what every browser with WebGL2 has, a branch."""

ARRAYS: dict[str, np.dtype] = {"geometry": np.dtype("<u4"), "colors": np.dtype("u1"), "rest": np.dtype("u1")}
BLOCK = re.compile(r'<script type="([a-z+/;0-9]+)" id="([a-z-]+)">([^<]*)</script>')

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
    if baked.keys > MOST_KEYS:
        raise ValueError(f"a page holds at most {MOST_KEYS} key times, got {baked.keys}")
    for name, branch in branches.items():
        if len(branch) > MOST_GAUSSIANS:
            raise ValueError(f"a page holds at most {MOST_GAUSSIANS:,} {name} Gaussians, got {len(branch):,}")
    facts = {
        "format": "warpgs page",
        "version": VERSION,
        "keys": baked.keys,
        "start": {field.name: getattr(start, field.name) for field in fields(start)},
        "branches": {name: _facts(branch) for name, branch in branches.items()},
    }
    blocks = [_block("application/json", "scene", json.dumps(facts).replace("<", "\\u003c"))]
    parts = [(name, array) for name in branches for array in ARRAYS]
    for name, array in progress(parts, "compressing", quiet):
        packed = gzip.compress(to_planes(getattr(branches[name], array)).tobytes(), 6, mtime=0)
        blocks.append(_block("application/gzip;base64", f"{name}-{array}", base64.b64encode(packed).decode()))
    return write_whole(path, [_page(start.title, "\n".join(blocks)).encode()])


def read_page(path: Path) -> Baked:
    """The numbers of a page.

    Raises:
        ValueError: If it is no such page, of another version, or damaged; the message names it.
    """
    try:
        text = read_bounded(path, LARGEST_PAGE).decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no page of warpgs: it is no text") from error
    blocks = {name: content for _, name, content in BLOCK.findall(text)}
    try:
        facts = json.loads(blocks["scene"])
        if facts["format"] != "warpgs page" or facts["version"] != VERSION:
            raise ValueError(f"it has version {facts['version']!r}, this program reads {VERSION}")
        if not 0 < int(facts["keys"]) <= MOST_KEYS:
            raise ValueError(f"it says that it has {facts['keys']!r} key times")
        static, dynamic = (_branch(blocks, name, facts["branches"][name]) for name in ("static", "dynamic"))
    except RecursionError as error:
        raise ValueError(f"{path} is no page of warpgs, or damaged: it is nested too deep") from error
    except (KeyError, TypeError, ValueError, zlib.error, EOFError, OverflowError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else error
        raise ValueError(f"{path} is no page of warpgs, or damaged: {reason}") from error
    return Baked(int(facts["keys"]), static, dynamic)


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


def _branch(blocks: dict[str, str], name: str, facts: dict[str, Any]) -> Branch:
    bounds = {field.name: np.asarray(facts[field.name], np.float64) for field in fields(Bounds)}
    if bounds["means"].shape != (2, 3) or any(bounds[f].shape != (2,) for f in ("log_scales", "colors", "rest")):
        raise ValueError(f"{name} has bounds of another shape")
    if not all(np.isfinite(values).all() for values in bounds.values()):
        raise ValueError(f"{name} has bounds that are not finite")
    arrays = {array: _array(blocks[f"{name}-{array}"], facts["shapes"][array], array) for array in ARRAYS}
    num = arrays["geometry"].shape[1]
    if arrays["colors"].shape[1] != num or arrays["rest"].shape[0] != num:
        raise ValueError(f"{name} has arrays of different lengths")
    return Branch(Bounds(**bounds), **arrays)


def _array(content: str, claimed: Any, name: str) -> np.ndarray:
    """What a block holds, which must be as much as its shape claims and no more."""
    shape, dtype = tuple(claimed), ARRAYS[name]
    most = (MOST_GAUSSIANS, 15, 3) if name == "rest" else (MOST_KEYS, MOST_GAUSSIANS, WORDS)
    if len(shape) != 3 or any(type(n) is not int or not 0 <= n <= m for n, m in zip(shape, most, strict=True)):
        raise ValueError(f"{name} has the shape {claimed!r}")
    if shape[2] != most[2]:
        raise ValueError(f"{name} has the shape {claimed!r}")
    size = int(np.prod(shape)) * dtype.itemsize
    try:
        packed = base64.b64decode(content, validate=True)
    except binascii.Error as error:
        raise ValueError(f"{name} is no base64") from error
    if size > 1100 * len(packed):  # gzip packs at most 1032 times
        raise ValueError(f"{name} is too short for its shape")
    expander = zlib.decompressobj(wbits=31)
    data = expander.decompress(packed, size + 1)
    if len(data) != size or not expander.eof:
        raise ValueError(f"{name} does not hold what its shape says")
    return from_planes(np.frombuffer(data, np.uint8), shape, dtype)
