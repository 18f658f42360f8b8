"""What to say of a capture that does not exist: similar folders nearby, and how to get a public dataset."""

import os
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

from warpgs.config.builtin import NAMES, PREFIX
from warpgs.errors import command, missing

from .published import dataset_in, find_dataset, words

CONFIG = "config.json"
"""File of a run folder, which is often named after its capture."""

MAX_FOLDERS = 2_000
"""Maximum number of folders that are looked at for a similar name."""

MAX_SIMILAR = 3
"""Maximum number of similar folders that are named."""

MAX_DEPTH = 3
"""How far below the last folder of the path that exists it is looked for."""


def missing_capture(path: Path, is_capture: Callable[[Path], bool]) -> str:
    """Message that a folder of a capture does not exist: similar ones, or where to get it and how to do without.

    Args:
        path: The folder.
        is_capture: Whether a folder looks like a capture.
    """
    text = missing(path)
    if f"{PREFIX}{path}" in NAMES or str(path) == PREFIX.rstrip(":"):
        return f"{text}; built-in captures are {', '.join(NAMES)}"
    if text == f"{path} does not exist" and (similar := similar_folders(path, is_capture)):
        text += f"; did you mean {' or '.join(map(str, similar))}?"
    if (dataset := dataset_in(path)) is None:
        return text
    source = download_of(path) or f"{dataset.title} is published at {dataset.address}"
    if text.endswith("?"):
        return f"{text} {source}"
    return (
        f"{text}; {source}; without a download there are {command('train')} (a built-in scene), --data builtin:studio "
        f"(a larger one) and {command('prepare', 'VIDEO', 'CAPTURE')} (your own video)"
    )


def download_of(path: Path) -> str | None:
    """How to download what a path names by its last parts, a dataset and a scene of it, or a dataset; None if neither.

    The end of a message: the command, and the folder that it makes, unless that is the path.
    """
    for folder, scenes in ((path.parent, [path.name]), (path, [])):
        dataset = find_dataset(folder.name)
        if dataset and dataset.releases and set(scenes) <= set(dataset.scenes):
            to = folder.parent
            made = Path(to, dataset.name, *scenes)
            options = [] if to.absolute() == Path.cwd() else ["--to", to]
            place = "" if made == path else f" to {made}"
            return f"{command('download', dataset.name, *scenes, *options)} downloads it{place}"
    return None


def similar_folders(path: Path, is_capture: Callable[[Path], bool]) -> list[Path]:
    """Folders with all words of a missing one's name, or with no others, such as ``as_novel_view`` for ``as``.

    They are in the last folder of the path that exists, or are captures farther below it; the most similar come first.
    """
    base = next((parent for parent in path.parents if os.path.isdir(parent)), Path())
    given = words(path.name)
    found = []
    for folder in islice(_folders(base, MAX_DEPTH), MAX_FOLDERS):
        own = words(folder.name)
        is_similar = given and own and (set(given) <= set(own) or set(own) <= set(given))
        if is_similar and (is_capture(folder) or (folder.parent == base and not (folder / CONFIG).exists())):
            found.append(("".join(own) != "".join(given), len(folder.parts), folder))
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
