"""Reading pictures, masks and depth: whole or not at all, and of the size that was expected."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from .reading import read_array, read_bytes

MAX_SIDE = 16_384
"""Pixels; a file that claims more is refused before anything is allocated for it."""

FILL_RADIUS = 3
"""Neighbourhood from which unknown pixels are filled [px]."""

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"


def decode(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> Shaped[np.ndarray, "H W ..."]:
    """The values of a PNG or JPEG file as stored, or as OpenCV's flags say, in OpenCV's order of channels.

    OpenCV decodes what it can of a damaged file, fills the rest with grey and complains on stderr, depending on its
    version; so the file is checked before.

    Raises:
        ValueError: If it is missing, truncated, damaged, too large or no PNG or JPEG.
    """
    data = read_bytes(path)
    if data.startswith(_PNG):
        size = _check_png(path, data)
    elif data.startswith(_JPEG):
        size = _check_jpeg(path, data)
    else:
        raise ValueError(f"{path} is no PNG or JPEG picture")
    if not 0 < min(size) <= max(size) <= MAX_SIDE:
        raise ValueError(f"{path} claims {size[0]}×{size[1]} pixels, expected 1 to {MAX_SIDE} a side")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"{path} can't be decoded as a picture")
    return image


def _check_png(path: Path, data: bytes) -> tuple[int, int]:
    """Goes through the chunks (length, type, content, checksum) up to IEND; returns width and height."""
    start, kind = len(_PNG), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(data[start : start + 4], "big"), data[start + 4 : start + 8]
        end = start + 8 + length
        if end + 4 > len(data):
            raise ValueError(f"{path} is truncated: its last chunk is cut off")
        if zlib.crc32(data[start + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise ValueError(f"{path} is damaged: a checksum is wrong")
        start = end + 4
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _check_jpeg(path: Path, data: bytes) -> tuple[int, int]:
    """Looks for the end mark, and for width and height in the frame header."""
    if not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise ValueError(f"{path} is truncated: its end mark is missing")
    for mark, content in _jpeg_segments(data):
        if 0xC0 <= mark <= 0xCF and mark not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(content[3:5], "big"), int.from_bytes(content[1:3], "big")
    raise ValueError(f"{path} is damaged: it has no frame header")


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    start = len(_JPEG)
    while start + 4 <= len(data) and data[start] == 0xFF:
        if data[start + 1] == 0xFF:  # padding before a mark
            start += 1
            continue
        length = int.from_bytes(data[start + 2 : start + 4], "big")
        yield data[start + 1], data[start + 4 : start + 2 + length]
        start += 2 + length


def _check_size(path: Path, what: str, array: np.ndarray, size: tuple[int, int]) -> None:
    width, height = array.shape[1::-1]
    if (width, height) != size:
        raise ValueError(f"{path}: {what} is {width}×{height}, expected {size[0]}×{size[1]} as its camera says")


def _to_8_bits(image: np.ndarray) -> np.ndarray:
    return (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else image


def read_image(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit RGB picture of ``size`` (width, height).

    Transparent pixels are filled from around: DyCheck made its training pictures from point clouds and leaves those
    that the sensor missed transparent, on black; black would be learnt.

    Raises:
        ValueError: If the file is missing, damaged or of another size.
    """
    stored = _to_8_bits(decode(path))
    _check_size(path, "the picture", stored, size)
    if stored.ndim == 2:
        return cv2.cvtColor(stored, cv2.COLOR_GRAY2RGB)
    image = cv2.cvtColor(stored[..., :3], cv2.COLOR_BGR2RGB)
    unknown = stored[..., 3:] < 128
    if unknown.any():
        return cv2.inpaint(image, unknown.astype(np.uint8), FILL_RADIUS, cv2.INPAINT_TELEA)
    return image


def read_mask(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """True where a mask file is brighter than half of its type's range, of ``size`` (width, height).

    Masks of 0 and 1 instead of 0 and 255, and 16-bit masks of 0 and 255, are taken as they are meant.

    Raises:
        ValueError: If the file is missing, damaged or of another size.
    """
    stored = decode(path)
    _check_size(path, "the mask", stored, size)
    if stored.ndim == 3:
        stored = cv2.cvtColor(stored[..., :3], cv2.COLOR_BGR2GRAY)
    brightest = next(most for most in (1, 255, 65535) if stored.max() <= most)
    return stored > brightest // 2


def read_depth(path: Path, size: tuple[int, int]) -> Float[np.ndarray, "H W"]:
    """Values of an 8- or 16-bit picture, scaled to [0, 1], or of a .npy file, resized to ``size`` (width, height).

    Networks often predict depth in a lower resolution than the picture's. What is not finite becomes NaN; planes with
    NaN or with 0, which mark unknown pixels in .npy files, are resized without mixing neighbours.

    Raises:
        ValueError: If the file is missing, damaged or holds no plane of numbers.
    """
    values: np.ndarray
    if path.suffix == ".npy":
        values = read_array(path, MAX_SIDE**2).astype(np.float32)
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
        holed = bool((~np.isfinite(values) | (values == 0)).any())
    else:
        stored = decode(path)
        values = stored.astype(np.float32) / np.iinfo(stored.dtype).max
        holed = False
    if values.ndim != 2 or not 0 < min(values.shape) <= max(values.shape) <= MAX_SIDE:
        raise ValueError(f"{path}: depth must be one plane of numbers, [H, W], got shape {list(values.shape)}")
    values[~np.isfinite(values)] = np.nan
    if values.shape[1::-1] == size:
        return values
    return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT if holed else cv2.INTER_LINEAR)
