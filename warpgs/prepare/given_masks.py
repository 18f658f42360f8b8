"""Masks that the user gives: a folder of PNG files, 0 = moving.

Named as the pictures of the source, they lie over these. Named as the capture's frames, they were drawn over the
pictures of a capture, which are straightened.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from warpgs.data.images import decode, read_mask

from .frames import SourceFrame

ENDINGS = (".png", ".png.png")
"""The second is that of captures."""


def find_masks(folder: Path, frames: Sequence[SourceFrame]) -> tuple[list[Path], bool]:
    """The mask of every frame, and whether they are named as the capture's frames: all are of one kind.

    Raises:
        ValueError: If one is missing.
    """
    as_source = [_file(folder, (Path(frame.source).stem, frame.source)) for frame in frames]
    as_frames = [_file(folder, (frame.name,)) for frame in frames]
    found = min(as_source, as_frames, key=lambda paths: paths.count(None))
    if None in found:
        frame = frames[found.index(None)]
        name = frame.name if found is as_frames else Path(frame.source).stem
        raise ValueError(f"{folder} has no mask for {frame.name} ({frame.source}): expected {name}.png")
    return [path for path in found if path is not None], found is as_frames


def _file(folder: Path, stems: Iterable[str]) -> Path | None:
    paths = (folder / (stem + ending) for stem in stems for ending in ENDINGS)
    return next((path for path in paths if path.is_file()), None)


def read_moving(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """True where a mask says that it moves, resized to ``size`` (width, height).

    Raises:
        ValueError: If it is damaged or of another shape than the picture.
    """
    width, height = decode(path).shape[1::-1]
    slack = 0.5 * (width + height + sum(size))  # both may have been rounded to whole pixels
    if abs(width * size[1] - height * size[0]) > slack:
        raise ValueError(
            f"{path}: the mask is {width}×{height}, which is not the shape of the {size[0]}×{size[1]} frame"
        )
    static = read_mask(path, (width, height)).astype(np.uint8)
    return cv2.resize(static, size, interpolation=cv2.INTER_NEAREST_EXACT) == 0
