"""What to say of a capture that does not exist: similar folders nearby, and where a public dataset is published."""

import os
import re
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from warpgs.errors import command, missing

CONFIG = "config.json"
"""File of a run folder, which is often named after its capture."""

MAX_FOLDERS = 2_000
"""Maximum number of folders that are looked at for a similar name."""

MAX_SIMILAR = 3
"""Maximum number of similar folders that are named."""

MAX_DEPTH = 3
"""How far below the last folder of the path that exists it is looked for."""


class Published(NamedTuple):
    """A public dataset.

    Attributes:
        title: Its name.
        address: Page that says how to download it.
        parts: Its names in paths, of lower-case letters and digits alone.
    """

    title: str
    address: str
    parts: tuple[str, ...]


PUBLISHED = (
    Published("NeRF-DS", "https://github.com/JokerYan/NeRF-DS/releases/tag/v0.1-pre-release", ("nerfds",)),
    Published("HyperNeRF", "https://github.com/google/hypernerf/releases/tag/v0.1", ("hypernerf",)),
    Published("Nerfies", "https://github.com/google/nerfies/releases", ("nerfies",)),
    Published(
        "the iPhone dataset of DyCheck",
        "https://github.com/KAIR-BAIR/dycheck/blob/main/docs/DATASETS.md",
        ("dycheck", "iphone"),
    ),
    Published("D-NeRF", "https://github.com/albertpumarola/D-NeRF", ("dnerf",)),
    Published(
        "the NVIDIA Dynamic Scene dataset",
        "https://gorokee.github.io/jsyoon/dynamic_synth",
        ("nvidia", "nvidiadynamic", "nvidiadynamicscene", "dynamicscene"),
    ),
    Published(
        "the example of NR-NeRF",
        "https://github.com/facebookresearch/nonrigid_nerf",
        ("nonrigidnerf", "nrnerf", "hand"),
    ),
)
"""Datasets whose layouts are read."""


def missing_folder(path: Path, is_capture: Callable[[Path], bool]) -> str:
    """Message that a folder of a capture does not exist: similar ones, or where to get it and how to do without.

    Args:
        path: The folder.
        is_capture: Whether a folder looks like a capture.
    """
    text = missing(path)
    if text == f"{path} does not exist" and (similar := similar_folders(path, is_capture)):
        text += f"; did you mean {' or '.join(map(str, similar))}?"
    if (dataset := published(path)) is None:
        return text
    source = f"{dataset.title} is published at {dataset.address}"
    if text.endswith("?"):
        return f"{text} {source}"
    return (
        f"{text}; {source}; without a download there are {command('train')} (a built-in scene), --data builtin:studio "
        f"(a larger one) and {command('prepare', 'VIDEO', 'CAPTURE')} (your own video)"
    )


def published(path: Path) -> Published | None:
    """The public dataset that a path is named after, if any."""
    for part in reversed(path.parts):
        name = "".join(_words(part))
        for dataset in PUBLISHED:
            if name in dataset.parts:
                return dataset
    return None


def similar_folders(path: Path, is_capture: Callable[[Path], bool]) -> list[Path]:
    """Folders with all words of a missing one's name, or with no others, such as ``as_novel_view`` for ``as``.

    They are in the last folder of the path that exists, or are captures farther below it; the most similar come first.
    """
    base = next((parent for parent in path.parents if os.path.isdir(parent)), Path())
    given = _words(path.name)
    found = []
    for folder in islice(_folders(base, MAX_DEPTH), MAX_FOLDERS):
        words = _words(folder.name)
        is_similar = given and words and (set(given) <= set(words) or set(words) <= set(given))
        if is_similar and (is_capture(folder) or (folder.parent == base and not (folder / CONFIG).exists())):
            found.append(("".join(words) != "".join(given), len(folder.parts), folder))
    return [folder for *_, folder in sorted(found)[:MAX_SIMILAR]]


def _folders(base: Path, depth: int) -> Iterator[Path]:
    """Folders below a folder, level by level, but for hidden ones."""
    level = [base]
    for _ in range(depth):
        inner: list[Path] = []
        for folder in level:
            inner += _in(folder)
            if len(inner) >= MAX_FOLDERS:
                break
        yield from inner
        level = inner


def _in(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in islice(entries, MAX_FOLDERS) if entry.is_dir(follow_symlinks=False))
    except OSError:  # it cannot be read
        return []
    return [folder / name for name in names if not name.startswith(".")]


def _words(name: str) -> list[str]:
    return re.findall(r"[^\W_]+", name.lower())
