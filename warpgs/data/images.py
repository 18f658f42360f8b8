"""Reading images, masks and depth; damaged files and files of another size are refused."""

import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from warpgs.files import read_array, read_bounded

from .exif import EXCHANGES_SIDES, INVERSE, orientation_of, upright

MAX_SIDE = 16_384
"""Maximum side of an image [px]; larger ones are refused before memory is allocated for them."""

MAX_PIXELS = 100_000_000
"""Maximum number of pixels of an image."""

MIN_MAX_DEPTH_PIXELS = 1 << 24
"""Depth may have at least this number of pixels, however small its image is; see ``read_depth``."""

MAX_DEPTH_FACTOR = 8
"""Depth may have this times the sides of its image: the full size serves images of every factor."""

MAX_OVERHEAD = 64 << 20
"""Maximum size of what an image file holds besides pixels, such as previews and profiles [bytes]."""

MAX_BYTES_PER_PIXEL = 9
"""RGBA of 16 bits, and what a compressor may add to pixels that it cannot compress [bytes]."""

MAX_PARTS = 1_000_000
"""Maximum number of chunks of a PNG or segments of a JPEG file."""

FILL_RADIUS = 3
"""Neighbourhood used to inpaint unknown pixels [px]."""

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_START_OF_SCAN = 0xDA
_PNG_COLOR_TYPE = 25
"""Offset of the byte that says whether a PNG image has colours (2), a palette (1) and alpha (4)."""


def decode(
    path: Path,
    flags: int = cv2.IMREAD_UNCHANGED,
    size: tuple[int, int] | None = None,
    what: str = "the image",
    max_pixels: int = MAX_PIXELS,
    image: Path | None = None,
) -> Shaped[np.ndarray, "H W ..."]:
    """The pixels of a PNG or JPEG file in OpenCV's channel order, as stored or converted as OpenCV's ``flags`` request.

    Some versions of OpenCV decode a damaged file partially, fill the rest with grey and warn on stderr, so the file is
    checked first.

    Args:
        path: The file.
        flags: OpenCV's flags.
        size: Expected width and height; another size is refused before memory is allocated for it.
        what: Name of the image in the message about its size.
        max_pixels: Maximum number of pixels if ``size`` is None.
        image: The image that it belongs to, whose EXIF orientation it may share; see ``turned``.

    Raises:
        ValueError: If it is missing, truncated, damaged, too large, of another size, or not a PNG or JPEG image.
    """
    if size is None:
        return _decode(path, _read_checked(path, max_pixels)[0], flags)
    data = read_bounded(path, MAX_OVERHEAD + MAX_BYTES_PER_PIXEL * size[0] * size[1])
    found = _check(path, data, MAX_PIXELS)
    orientation = orientation_to(path, found, size.__eq__, image)
    if found != size and orientation == 1:
        raise ValueError(
            f"{path}: {what} is {found[0]}×{found[1]}, expected {size[0]}×{size[1]}, the image_size of its camera"
            f"{exchanged_sides(path, found, size.__eq__)}"
        )
    return upright(_decode(path, data, flags), orientation)


def decode_bytes(path: Path, data: bytes) -> Shaped[np.ndarray, "H W ..."]:
    """The pixels of the content of a PNG or JPEG file, as ``decode``; ``path`` is for messages."""
    _check(path, data, MAX_PIXELS)
    return _decode(path, data, cv2.IMREAD_UNCHANGED)


def _decode(path: Path, data: bytes, flags: int) -> Shaped[np.ndarray, "H W ..."]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"{path} cannot be decoded as an image")
    return image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a PNG or JPEG file, without decoding it; raises as ``decode``."""
    return _read_checked(path, MAX_PIXELS)[1]


def indices_of(path: Path) -> UInt8[np.ndarray, "H W"] | None:
    """The indices of a PNG file with a palette of colours; None of greys or of another file; raises as ``decode``.

    OpenCV gives colours only, of which several indices may have one: it gets a palette of greys, one for each index.
    """
    data = _read_checked(path, MAX_PIXELS)[0]
    if not data.startswith(_PNG) or data[_PNG_COLOR_TYPE : _PNG_COLOR_TYPE + 1] != b"\x03":
        return None
    start = data.find(b"PLTE")
    if start < 0:
        raise ValueError(f"{path} is damaged: it has no palette for its indices of colours")
    length = int.from_bytes(data[start - 4 : start], "big")
    palette = np.frombuffer(data, np.uint8, length - length % 3, start + 4).reshape(-1, 3)
    if (palette == palette[:, :1]).all():
        return None
    chunk = b"PLTE" + np.repeat(np.arange(len(palette), dtype=np.uint8), 3).tobytes()
    chunk += zlib.crc32(chunk).to_bytes(4, "big")
    rest = data[start + 4 + length + 4 :]
    return _decode(path, data[: start - 4] + (len(chunk) - 8).to_bytes(4, "big") + chunk + rest, cv2.IMREAD_GRAYSCALE)


def is_transparent(path: Path) -> bool:
    """Whether a file is a PNG image with a pixel that is not opaque; it is decoded only if it may have one.

    Raises:
        ValueError: If it is missing, or a PNG image that is damaged.
    """
    data = read_bounded(path, MAX_OVERHEAD + MAX_BYTES_PER_PIXEL * MAX_PIXELS)
    if not data.startswith(_PNG):
        return False
    # Without a channel for it, transparent colours are in a chunk tRNS before the pixels, e.g. of a palette.
    if data[_PNG_COLOR_TYPE : _PNG_COLOR_TYPE + 1] not in (b"\x04", b"\x06") and b"tRNS" not in data.split(b"IDAT")[0]:
        return False
    stored = decode_bytes(path, data)
    return bool(stored.ndim == 3 and stored.shape[2] == 4 and stored[..., 3].min() < np.iinfo(stored.dtype).max)


Fits = Callable[[tuple[int, int]], bool]
"""Whether a (width, height) fits."""


def orientation_to(path: Path, stored: tuple[int, int], fits: Fits, image: Path | None = None) -> int:
    """The EXIF orientation with which a file fits that does not fit as stored; 1 if there is none.

    Args:
        path: The file.
        stored: Its (width, height).
        fits: Whether a size fits the camera.
        image: The image that the file belongs to: a mask without an orientation of its own may have been made of the
            stored pixels while the camera is that of the upright image, or the reverse.
    """
    if fits(stored) or not fits(stored[::-1]):
        return 1
    orientation = orientation_of(path)
    if orientation < EXCHANGES_SIDES and image is not None:
        orientation = orientation_of(image)
        if orientation >= EXCHANGES_SIDES and fits(image_size(image)):
            orientation = INVERSE.get(orientation, orientation)
    return orientation if orientation >= EXCHANGES_SIDES else 1


def turned(
    path: Path, pixels: Shaped[np.ndarray, "h w ..."], fits: Fits, image: Path | None = None
) -> Shaped[np.ndarray, "H W ..."]:
    """The pixels of a file, turned as ``orientation_to`` says if they do not fit as stored."""
    return upright(pixels, orientation_to(path, (pixels.shape[1], pixels.shape[0]), fits, image))


def exchanged_sides(path: Path, stored: tuple[int, int], fits: Fits) -> str:
    """The end of a message about a size that does not fit: how the file is shown, and whether turning it helps."""
    orientation = orientation_of(path)
    shown = f"; its EXIF orientation is {orientation}" if orientation > 1 else ""
    return f"{shown}; its sides are exchanged: rotate its pixels by 90°" if fits(stored[::-1]) else shown


def has_shape(stored: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether a (width, height) is a multiple of ``size``, apart from rounding to whole pixels."""
    (width, height), total = stored, sum(stored) + sum(size)
    return min(stored) > 0 and abs(width * size[1] - height * size[0]) <= 0.5 * total


def _read_checked(path: Path, max_pixels: int) -> tuple[bytes, tuple[int, int]]:
    """The content of an image file, and its width and height."""
    data = read_bounded(path, MAX_OVERHEAD + MAX_BYTES_PER_PIXEL * max_pixels)
    return data, _check(path, data, max_pixels)


def _check(path: Path, data: bytes, max_pixels: int) -> tuple[int, int]:
    """Width and height of the content of an image file."""
    if data.startswith(_PNG):
        width, height = _check_png(path, data)
    elif data.startswith(_JPEG):
        width, height = _check_jpeg(path, data)
    else:
        raise ValueError(f"{path} is not a PNG or JPEG image")
    if not 0 < min(width, height) <= max(width, height) <= MAX_SIDE:
        raise ValueError(f"{path} claims {width}×{height} pixels, expected 1 to {MAX_SIDE} per side")
    if width * height > max_pixels:
        raise ValueError(f"{path} claims {width}×{height} pixels, expected at most {max_pixels:,} together")
    return width, height


def _check_png(path: Path, data: bytes) -> tuple[int, int]:
    """Checks the chunks (length, type, content, checksum) up to IEND; returns width and height."""
    start, chunk, count = len(_PNG), b"", 0
    while chunk != b"IEND":
        count += 1
        length, chunk = int.from_bytes(data[start : start + 4], "big"), data[start + 4 : start + 8]
        end = start + 8 + length
        if end + 4 > len(data):
            raise ValueError(f"{path} is truncated: its last chunk is cut off")
        if zlib.crc32(data[start + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise ValueError(f"{path} is damaged: a checksum is wrong")
        if (count == 1) != (chunk == b"IHDR") or count > MAX_PARTS:
            raise ValueError(f"{path} is damaged: its first chunk must be its header, with at most {MAX_PARTS:,} more")
        start = end + 4
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _check_jpeg(path: Path, data: bytes) -> tuple[int, int]:
    """Checks the end marker of the image; returns width and height from the frame header.

    Phones append data to the image (Samsung's SEFT, motion photos), and previews in segments have end markers of their
    own, so it is looked for in the scans.
    """
    size, end = _jpeg_header(data)
    if data.find(b"\xff\xd9", end) < 0:
        raise ValueError(f"{path} is truncated: its end marker is missing")
    if size is None:
        raise ValueError(f"{path} is damaged: it has no frame header")
    return size


def _jpeg_header(data: bytes) -> tuple[tuple[int, int] | None, int]:
    """Width and height, None if no frame header is found, and the offset at which the first scan begins."""
    size, start = None, len(_JPEG)
    for _ in range(MAX_PARTS):
        if start + 4 > len(data) or data[start] != 0xFF:
            break
        marker = data[start + 1]
        if marker == 0xFF:  # padding before a marker
            start += 1
            continue
        if size is None and 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = (int.from_bytes(data[k : k + 2], "big") for k in (start + 5, start + 7))
            size = width, height
        start += 2 + int.from_bytes(data[start + 2 : start + 4], "big")
        if marker == _START_OF_SCAN:
            break
    return size, start


def to_8_bits(image: np.ndarray) -> np.ndarray:
    """The image with 8 bits per channel."""
    if image.dtype != np.uint16:
        return image
    return np.right_shift(image, 8, out=np.empty(image.shape, np.uint8), casting="unsafe")  # no copy in 16 bits


def read_image(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit RGB image of ``size`` (width, height).

    Transparent pixels are inpainted: DyCheck renders its training images from point clouds and leaves pixels that the
    sensor missed transparent, on black, which would be learnt.

    Raises:
        ValueError: If the file is missing, damaged or of another size.
    """
    return fill_transparent(to_8_bits(decode(path, size=size)))


def fill_transparent(stored: UInt8[np.ndarray, "H W ..."]) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of an image in grey or in OpenCV's channel order, with transparent pixels inpainted."""
    if stored.ndim == 2:
        return cv2.cvtColor(stored, cv2.COLOR_GRAY2RGB)
    image = cv2.cvtColor(stored[..., :3], cv2.COLOR_BGR2RGB)
    unknown = stored[..., 3:] < 128
    if unknown.any():
        return cv2.inpaint(image, unknown.astype(np.uint8), FILL_RADIUS, cv2.INPAINT_TELEA)
    return image


def read_mask(path: Path, size: tuple[int, int], image: Path | None = None) -> Bool[np.ndarray, "H W"]:
    """True where a mask file is brighter than half of its type's range, of ``size`` (width, height).

    Masks of 0 and 1 instead of 0 and 255, and 16-bit masks of 0 and 255, are read correctly too. ``image`` is the image
    that it belongs to; see ``turned``.

    Raises:
        ValueError: If the file is missing, damaged or of another size.
    """
    return is_bright(path, decode(path, size=size, what="the mask", image=image))


def is_bright(path: Path, stored: Shaped[np.ndarray, "H W ..."]) -> Bool[np.ndarray, "H W"]:
    """Where the colour of a mask is brighter than half of the range that its values suggest: 0 to 1, 255 or 65535.

    Raises:
        ValueError: If only its alpha channel, which is not read, tells pixels apart.
    """
    if stored.ndim == 3:
        if (stored[..., :3] == stored[0, 0, :3]).all() and (stored[..., 3:] != stored[0, 0, 3:]).any():
            raise ValueError(
                f"{path}: the mask has one colour everywhere and differs in its alpha channel only, which is not read: "
                "store it in black and white"
            )
        stored = cv2.cvtColor(stored[..., :3], cv2.COLOR_BGR2GRAY)
    largest = next(value for value in (1, 255, 65535) if stored.max() <= value)
    return stored > largest // 2


def max_depth_pixels(size: tuple[int, int]) -> int:
    """Maximum number of pixels of the depth of an image of a (width, height)."""
    return max(MIN_MAX_DEPTH_PIXELS, min(MAX_PIXELS, MAX_DEPTH_FACTOR**2 * size[0] * size[1]))


def read_depth(path: Path, size: tuple[int, int], image: Path | None = None) -> Float[np.ndarray, "H W"]:
    """An 8- or 16-bit image, scaled to [0, 1], or a .npy file, resized to ``size`` (width, height).

    Networks often predict depth at a lower resolution than the image. Values that are not finite become NaN. In .npy
    files NaN and 0 mark unknown pixels; arrays that have any are resized without interpolation. Depth may have 8 times
    the sides of the image, or 16 million pixels if that is more. ``image`` is the image that it belongs to; see
    ``turned``.

    Raises:
        ValueError: If the file is missing or damaged, or does not hold an [H, W] array.
    """
    values: np.ndarray
    max_pixels = max_depth_pixels(size)
    if path.suffix.lower() == ".npy":
        with np.errstate(over="ignore"):  # what is not finite then is unknown
            values = read_array(path, max_pixels).astype(np.float32)
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
        has_unknown = bool((~np.isfinite(values) | (values == 0)).any())
    else:
        stored = decode(path, max_pixels=max_pixels)
        values = stored.astype(np.float32) / np.iinfo(stored.dtype).max
        has_unknown = False
    if values.ndim != 2 or not 0 < min(values.shape) <= max(values.shape) <= MAX_SIDE:
        raise ValueError(f"{path}: depth must be one channel, [H, W], got shape {list(values.shape)}")
    values = turned(path, values, lambda stored: has_shape(stored, size), image)
    values[~np.isfinite(values)] = np.nan
    if values.shape[1::-1] == size:
        return values
    return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT if has_unknown else cv2.INTER_LINEAR)
