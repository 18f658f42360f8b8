"""Notes on images in the folders of a capture that are not among its frames."""

import os
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of images, in lower case."""

MAX_LISTED = 1_000_000
"""Maximum number of files that are looked at; a folder with more is not counted."""


def skipped_images(
    root: Path, used: Iterable[Path], reason: str, folder: Path | None = None, others: Collection[Path] = ()
) -> tuple[str, ...]:
    """A note on the images that are skipped, if there are any.

    Files whose names extend that of a used image, such as r_000_depth.png next to r_000.png, are not images of their
    own.

    Args:
        root: Folder of the capture, for the note.
        used: The images of the frames.
        reason: Why the others are skipped, for the end of the note.
        folder: Folder that is searched with the folders in it; those that the used images are in if None.
        others: Files that are used as something else, such as masks.
    """
    used = {Path(os.path.abspath(path)) for path in used}
    stems = {path.parent / path.stem for path in used}
    folders = sorted({path.parent for path in used}) if folder is None else [Path(os.path.abspath(folder))]
    if not folders:
        return ()
    common = Path(os.path.commonpath(folders))
    known = used | {Path(os.path.abspath(path)) for path in others}
    unused, count = [], 0
    for count, path in enumerate(_images(folders, within=folder is not None), 1):
        if count > MAX_LISTED:
            return ()
        if path not in known and not _extends(path, stems):
            unused.append(path)
    if not unused:
        return ()
    shown = os.path.relpath(common, os.path.abspath(root))
    which = f"{len(unused)} of {len(used) + len(unused)} images in {'the capture' if shown == '.' else shown}"
    return (f"{which} are skipped, such as {min(unused).relative_to(common)}: {reason}",)


def _images(folders: Iterable[Path], within: bool) -> Iterator[Path]:
    for folder in folders:
        for parent, _, names in os.walk(folder):
            for name in names:
                if Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith("."):
                    yield Path(parent) / name
            if not within:
                break


def _extends(path: Path, stems: set[Path]) -> bool:
    """Whether the name of an image begins with the name of a used one and a separator."""
    return any(path.parent / path.stem[: end.start()] in stems for end in re.finditer(r"[\W_]", path.stem))
