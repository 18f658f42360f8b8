"""The files that a preparation keeps its masks in."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from warpgs.data.images import read_mask
from warpgs.files import read_json, write_json, write_png

from ..cameras.recovered import Cameras

INDEX = "masks.json"
"""Index of the masks in their folder, with ``dynamic_fraction``."""


@dataclass(frozen=True)
class Masks:
    """Masks of all frames, in files <folder>/<name>.png.png with 0 = dynamic, as COLMAP reads them.

    Attributes:
        folder: Folder of the files; None if nothing is dynamic.
        dynamic_fraction: Fraction of the pixels that are dynamic.
        estimated: Whether a method of ``MASKERS`` found them, instead of the user giving them.
    """

    folder: Path | None = None
    dynamic_fraction: float = 0.0
    estimated: bool = False

    @staticmethod
    def load(folder: Path) -> "Masks":
        """The masks that ``write_masks`` wrote."""
        index = read_json(folder / INDEX)
        return Masks(folder, float(index["dynamic_fraction"]))

    def read_dynamic(self, cameras: Cameras) -> list[Bool[np.ndarray, "H W"]]:
        """[H, W] the dynamic mask of each frame of the cameras, in the size of the lens.

        Raises:
            ValueError: If a file was damaged since it was written.
        """
        size = cameras.lens.width, cameras.lens.height
        if self.folder is None:
            return [np.zeros(size[::-1], bool) for _ in cameras.names]
        return [~read_mask(self.folder / f"{name}.png.png", size) for name in cameras.names]


def mask_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """The files that ``write_masks`` writes."""
    return [folder / INDEX, *(folder / f"{name}.png.png" for name in names)]


def write_masks(folder: Path, cameras: Iterable[tuple[Sequence[str], Sequence[Bool[np.ndarray, "H W"]]]]) -> str:
    """Writes the masks of the frames; returns a summary.

    Args:
        folder: Folder of the files.
        cameras: Names of each camera's frames, and their [H, W] dynamic masks.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    fractions = []
    for names, dynamic in cameras:
        for name, mask in zip(names, dynamic, strict=True):
            write_png(folder / f"{name}.png.png", (~mask).astype(np.uint8) * 255)
            fractions.append(mask.mean())
    fraction = float(np.mean(fractions))
    write_json(folder / INDEX, {"dynamic_fraction": fraction})
    return f"{fraction:.1%} of the pixels move"
