"""Notes on images that are stored turned, as their EXIF orientation says."""

from collections.abc import Sequence
from pathlib import Path

from warpgs.data.exif import EXCHANGES_SIDES, orientation_of
from warpgs.data.images import has_shape, image_size
from warpgs.data.sampling import evenly_spaced_indices

MAX_LOOKED_AT = 64
"""Number of images whose orientation is looked at; those of one camera usually have one."""


def turning_notes(images: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> list[str]:
    """Notes on images that are turned for their cameras, and on one whose size does not tell whether it should be.

    Args:
        images: The images of the frames.
        sizes: (width, height) of their cameras.
    """
    turned, notes = [], []
    for k in evenly_spaced_indices(len(images), MAX_LOOKED_AT):
        path, size = images[k], sizes[k]
        if (orientation := orientation_of(path)) == 1:
            continue
        stored = image_size(path)
        fits, fits_upright = has_shape(stored, size), has_shape(stored[::-1], size)
        if orientation < EXCHANGES_SIDES or (fits and fits_upright):
            notes.append(unclear_note(path))
        elif fits_upright:
            turned.append(path.name)
    if turned:
        text = "are turned as their EXIF orientation says, to the size of their cameras"
        notes.insert(0, f"images such as {turned[0]} {text}")
    return notes[: 1 + bool(turned)]


def unclear_note(image: Path) -> str:
    """A note on an image that is stored turned, where nothing tells whether its camera is."""
    which = f"images such as {image.name}, with the EXIF orientation {orientation_of(image)},"
    remedy = "turn the files, for example with mogrify -auto-orient"
    return f"{which} are read as stored; if the cameras belong to upright images, {remedy}"
