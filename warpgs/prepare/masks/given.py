"""Masks given by the user: a folder of PNG files, 0 = dynamic, named like the source's files or a capture's frames."""

from collections.abc import Sequence
from pathlib import Path

from warpgs.data.loaders.listed import find_file

from ..frames.take import SourceFrame

SUFFIXES = (".png", ".png.png")
"""Suffixes of mask files; captures use the second."""


def find_given_masks(folder: Path, frames: Sequence[SourceFrame]) -> list[Path]:
    """The mask of every frame. All must be named the same way. Masks of a video are named like its frames.

    Raises:
        ValueError: If one is missing.
    """

    def find(*stems: str) -> Path | None:
        return next((path for stem in stems if (path := find_file(folder, stem, SUFFIXES))), None)

    as_frames = [find(frame.name) for frame in frames]
    found, are_files = as_frames, all(Path(frame.source).suffix for frame in frames)
    if are_files:
        as_source = [find(Path(frame.source).stem, frame.source) for frame in frames]
        found = min(as_source, as_frames, key=lambda paths: paths.count(None))
    if None in found:
        frame = frames[found.index(None)]
        name = frame.name if found is as_frames else Path(frame.source).stem
        raise ValueError(f"{folder} has no mask for {frame.name} ({frame.source}): expected {name}.png")
    return [path for path in found if path is not None]
