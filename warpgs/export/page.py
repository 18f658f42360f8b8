"""One HTML file that plays a dynamic scene without a network: the integers of ``baking``, compressed, and a player.

The player is in ``player/``: the page, its style sheet, two shaders, and two scripts, one of which sorts in a worker.
The data are in the page as elements ``<script type="application/gzip">`` next to a JSON object with their shapes and
steps, as text of seven bits per character (``to_text``); browsers do not run scripts of this type. The player restores
the values and packs them for the GPU.
"""

import html
import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32, UInt8

from warpgs.command_line.progress import progress
from warpgs.editing.contribution import contribution, sample_cameras
from warpgs.files import encode_png, write_bytes, write_png
from warpgs.formats.packing import to_planes
from warpgs.video.camera_paths import evenly_spaced
from warpgs.video.filmed import DRAG_LIMIT, REACH, Filmed

from .baking import PARTS, Baked, Branch, bake, texture_bytes
from .job import Job, Writer
from .moving import KEYS, SECONDS
from .share import card, picture, picture_path
from .start_camera import StartView, start_view
from .transform import Levels

VERSION = 3
MAX_MEGABYTES = 256.0
"""Default of the option."""

MAX_KEYS = 256
"""Maximum number of key times: texture layers that every browser with WebGL2 supports."""

MAX_GAUSSIANS = 1 << 22
"""Maximum number of Gaussians per branch: texels of a 2048 × 2048 texture, which every browser with WebGL2 supports."""

DIFFERENCES = "means"
"""The part whose lowest coefficients are stored as differences: neighbours along the Morton curve are close."""

MAX_TITLE = 200
"""Maximum number of characters of a title; services that show links cut longer ones."""

PLACEHOLDER = re.compile(r"\[\[([a-z.]+)\]\]")
"""Marks where the player's page includes another of its files, the title or the scene."""

REPLACED = "\0\r<"
"""Characters that a page cannot hold as they are: browsers replace NUL, CR becomes LF, and < could end the element."""


def write_page(
    path: Path,
    baked: Baked,
    start: StartView,
    quiet: bool = True,
    url: str | None = None,
    sky: UInt8[np.ndarray, "rows columns 3"] | None = None,
) -> int:
    """Writes the page; returns its size [bytes].

    Args:
        path: The file.
        baked: The scene.
        start: How the page starts.
        quiet: Whether to show no progress.
        url: Address of the folder in which it will be; None if that is not known.
        sky: [rows, columns, 3] colours by direction behind everything (``Dome.image``); None without.

    Raises:
        ValueError: If the scene has more key times or Gaussians than browsers support.
        OSError: If it cannot be written; the message names the file.
    """
    branches = {"static": baked.static, "dynamic": baked.dynamic}
    check_size({name: len(branch) for name, branch in branches.items()}, baked.keys)
    blocks = [_block("application/json", "scene", _content(baked, start))]
    parts = [(name, part) for name in branches for part in PARTS]
    for name, part in progress(parts, "compressing", quiet):
        levels: Levels = getattr(branches[name], part)
        blocks.append(_packed(f"{name}-{part}", _differences(levels.levels) if part == DIFFERENCES else levels.levels))
        blocks.append(_packed(f"{name}-{part}-basis", levels.basis[:, :, None]))
    blocks += [_packed(f"{name}-octaves", branch.octaves[None, :, None]) for name, branch in branches.items()]
    blocks += [] if sky is None else [_block("image/png", "sky", to_text(encode_png(sky)))]
    shared = card(start, len(baked.static) + len(baked.dynamic), path, url)
    # Characters of names that are not UTF-8 have no place in a page; browsers show question marks.
    return write_bytes(path, [_player(start.title, shared, "\n".join(blocks)).encode(errors="replace")])


def _content(baked: Baked, start: StartView) -> str:
    """The shapes and steps of the data, and how the page starts, as JSON."""
    metadata = {
        "format": "warpgs page",
        "version": VERSION,
        "keys": baked.keys,
        "start": {field.name: getattr(start, field.name) for field in fields(start) if field.name != "filmed"},
        "filmed": _filmed(start.filmed),
        "branches": {
            name: _metadata(branch) for name, branch in (("static", baked.static), ("dynamic", baked.dynamic))
        },
    }
    return json.dumps(metadata, allow_nan=False).replace("<", "\\u003c")


def check_size(counts: Mapping[str, int], keys: int) -> None:
    """Refuses a scene that is too large for browsers.

    Args:
        counts: Number of Gaussians of each branch.
        keys: Number of key times.

    Raises:
        ValueError: If there are too many.
    """
    if keys > MAX_KEYS:
        raise ValueError(f"a page holds at most {MAX_KEYS} key times, got {keys}")
    for name, count in counts.items():
        if count > MAX_GAUSSIANS:
            raise ValueError(f"a page holds at most {MAX_GAUSSIANS:,} {name} Gaussians, got {count:,}")


def _player(title: str, shared: str, blocks: str) -> str:
    """The player with a scene in it, and the elements for programs that show it where its address is shared."""
    folder = resources.files(__package__) / "player"
    given = {"title": html.escape(title), "card": shared, "scene": blocks}

    def content(placeholder: re.Match[str]) -> str:
        name = placeholder[1]
        return given[name] if name in given else (folder / name).read_text("utf-8")

    return PLACEHOLDER.sub(content, (folder / "page.html").read_text("utf-8"))


def _block(mime_type: str, name: str, content: str) -> str:
    return f'<script type="{mime_type}" id="{name}">{content}</script>'


def _filmed(filmed: Filmed | None) -> dict[str, Any] | None:
    """What was filmed, in numbers of five digits."""
    if filmed is None:
        return None
    numbers = {field.name: np.round(getattr(filmed, field.name), 5).tolist() for field in fields(filmed)}
    return {**numbers, "reach": REACH, "limit": DRAG_LIMIT}


def _metadata(branch: Branch) -> dict[str, Any]:
    parts: dict[str, Levels] = {name: getattr(branch, name) for name in PARTS}
    return {name: {"shape": part.levels.shape, "steps": part.steps.tolist()} for name, part in parts.items()}


def _packed(name: str, integers: Int32[np.ndarray, "K N C"]) -> str:
    """Integers as gzip; run lengths alone compress planes that are mostly zero better than repeated strings do."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, 16 + zlib.MAX_WBITS, strategy=zlib.Z_RLE)
    packed = compressor.compress(to_planes(integers).tobytes()) + compressor.flush()
    return _block("application/gzip", name, to_text(packed))


def to_text(data: bytes) -> str:
    """Bytes as text in a ``<script>`` element of a UTF-8 page: 8 / 7 of their size, where base64 takes 4 / 3.

    A character holds seven bits. One of ``REPLACED`` and the character after it become one character between 128 and
    511, which takes two bytes in UTF-8, as they would; a last one becomes 512 plus itself.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    groups = np.pad(bits, (0, -len(bits) % 7)).reshape(-1, 7)
    characters = (np.packbits(groups, axis=1) >> 1).tobytes().decode("ascii")
    return re.sub(f"([{REPLACED}])(.?)", _replacement, characters, flags=re.DOTALL)


def _replacement(match: re.Match[str]) -> str:
    first, second = match[1], match[2]
    return chr(128 * (1 + REPLACED.index(first)) + ord(second)) if second else chr(512 + ord(first))


def _differences(levels: Int32[np.ndarray, "K N C"]) -> Int32[np.ndarray, "K N C"]:
    """The levels, the first of each series as the difference from that of the neighbour."""
    return np.concatenate([np.diff(levels[:1], axis=1, prepend=0), levels[1:]]).astype(np.int32)


def _check_memory(job: Job, keys: int) -> None:
    """Refuses a page that would take more memory than allowed, before anything is baked."""
    cloud = job.clouds.at(0.0)
    num_static, num_dynamic = int((~cloud.is_dynamic).sum()), int(cloud.is_dynamic.sum())
    check_size({"static": num_static, "dynamic": num_dynamic}, keys)
    fades = job.clouds.scene.scene.num_segments > 1
    size = texture_bytes(num_static, num_dynamic, keys, cloud.sh.shape[1] - 1, fades)
    maximum = job.options.max_megabytes or MAX_MEGABYTES
    if size > maximum * 1e6:
        fitting = int(len(cloud) * maximum * 1e6 / size)
        raise ValueError(
            f"the page would hold {size / 1e6:.0f} MB for {len(cloud):,} Gaussians at {keys} key times, more "
            f"than {maximum:g} MB: use about --max-gaussians {fitting}, fewer --keys, or --max-megabytes"
        )


def _write(job: Job) -> str:
    options, path = job.options, job.file("scene.html")
    keys = options.keys or KEYS
    if options.title is not None and len(options.title) > MAX_TITLE:
        raise ValueError(f"--title must have at most {MAX_TITLE} characters, got {len(options.title):,}")
    _check_memory(job, keys)
    start = start_view(job.clouds, job.capture, keys, options.seconds or SECONDS)
    start = start if options.title is None else replace(start, title=options.title)
    scene = job.clouds.scene
    weights = contribution(scene, sample_cameras(scene, job.capture), options.quiet).largest.numpy()
    times = progress(evenly_spaced(keys), "baking", options.quiet)
    baked = bake(job.clouds.at, times, options.precision or 1.0, weights)
    dome = scene.scene.dome
    size = write_page(path, baked, start, options.quiet, options.url, None if dome is None else dome.image())
    write_png(picture_path(path), picture(scene, start))
    count = f"{len(baked.static):,} static and {len(baked.dynamic):,} dynamic Gaussians at {baked.keys} key times"
    shared = f"{picture_path(path).name}: its picture where its address is shared"
    sky = "" if dome is None else ", with its sky"
    return f"{path}: {count}, {size / 1e6:.1f} MB{sky}\n{shared}\nviews and camera path: {job.capture_note}"


OPTIONS = ("keys", "seconds", "max_megabytes", "precision", "title", "url")
PAGE = Writer(_write, OPTIONS, ".html", has_background=True, has_sky=True, y_up=None)
"""The format "html"."""
