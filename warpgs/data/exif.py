"""The EXIF orientation of images: how the stored pixels must be turned or mirrored to be upright.

Phones and cameras store what their sensor saw and only note how they were held. Programs differ in whether they turn
the pixels, so the size of a camera decides: an orientation from 5 to 8 exchanges the sides.
"""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

EXCHANGES_SIDES = 5
"""Smallest orientation that exchanges width and height."""

INVERSE = {6: 8, 8: 6}
"""Orientations that undo others; the rest undo themselves."""

MAX_HEADER = 256 << 10
"""Size of the beginning of a file that may hold the orientation [bytes]; segments of JPEG files have at most 64 KiB."""

_ORIENTATION = 0x0112
_MAX_FIELDS = 1000


def orientation_of(path: Path) -> int:
    """The EXIF orientation of an image file, 1 to 8; 1 if it has none or cannot be read."""
    try:
        if not path.is_file():
            return 1
        with path.open("rb") as file:
            return _orientation(file.read(MAX_HEADER))
    except OSError:
        return 1


def upright(pixels: Shaped[np.ndarray, "h w ..."], orientation: int) -> Shaped[np.ndarray, "H W ..."]:
    """Pixels turned and mirrored as an EXIF orientation says."""
    if orientation >= EXCHANGES_SIDES:
        pixels = pixels.swapaxes(0, 1)
    across = orientation in (2, 3, 6, 7)
    down = orientation in (3, 4, 7, 8)
    return np.ascontiguousarray(pixels[:: -1 if down else 1, :: -1 if across else 1])


def _orientation(data: bytes) -> int:
    start = _start_of_exif(data)
    try:
        order = {b"II": "<", b"MM": ">"}[data[start : start + 2]]
        (fields,) = struct.unpack_from(f"{order}4xI", data, start)
        (count,) = struct.unpack_from(f"{order}H", data, start + fields)
        for k in range(min(count, _MAX_FIELDS)):
            tag, value = struct.unpack_from(f"{order}H6xH", data, start + fields + 2 + 12 * k)
            if tag == _ORIENTATION:
                return value if 1 <= value <= 8 else 1
    except (KeyError, struct.error):
        pass
    return 1


def _start_of_exif(data: bytes) -> int:
    """Offset of the EXIF fields; the end of the data if there are none."""
    if not data.startswith(b"\xff\xd8"):
        chunk = data.find(b"eXIf", 0, max(0, data.find(b"IDAT")))
        return chunk + 4 if data.startswith(b"\x89PNG") and chunk >= 0 else len(data)
    start = 2
    while data[start : start + 1] == b"\xff" and data[start + 1 : start + 2] != b"\xda":
        if data[start + 1 : start + 2] == b"\xe1" and data[start + 4 : start + 10] == b"Exif\0\0":
            return start + 10
        start += 2 + int.from_bytes(data[start + 2 : start + 4], "big")
    return len(data)
