"""One channel of OpenEXR files: scan lines, uncompressed or compressed by ZIP, as depth is usually stored.

The format is https://openexr.com/en/latest/OpenEXRFileLayout.html. PyAV and OpenCV's wheels do not read depth channels.
"""

import struct
import zlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .images import MAX_PIXELS, MAX_SIDE

MAGIC = b"v/1\x01"

TILED, MULTI_PART, DEEP = 0x200, 0x1000, 0x800
"""Flags of the version field, of files that are not read."""

LINES = {0: 1, 2: 1, 3: 16}
"""Lines per block of each compression: none, ZIPS and ZIP."""

PIXEL_TYPES: dict[int, np.dtype] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}


MAX_CHANNELS = 64
"""Maximum number of channels."""

MAX_RATIO = 1032
"""Bytes that deflate makes of one at most."""

DAMAGED = "damaged or truncated OpenEXR data"


class _Header(NamedTuple):
    channels: list[tuple[str, np.dtype]]
    compression: int
    width: int
    height: int
    top: int
    end: int


def exr_size(data: bytes) -> tuple[int, int]:
    """Width and height of the content of a file, without decoding it; raises as ``read_exr_channel``."""
    header = _header(data)
    return header.width, header.height


def read_exr_channel(data: bytes, channel: str, max_pixels: int = MAX_PIXELS) -> Float[np.ndarray, "H W"]:
    """A channel of floating-point numbers, as float32.

    Args:
        data: Content of the file.
        channel: Name of the channel, such as "Z".
        max_pixels: Maximum number of pixels.

    Raises:
        ValueError: If the data are damaged or truncated, of another kind, too large, or lack the channel; before
            memory is allocated for more than they can hold.
    """
    header = _header(data)
    if header.width * header.height > max_pixels:
        raise ValueError(f"an OpenEXR image of {header.width}×{header.height} pixels, more than {max_pixels:,}")
    try:
        return _pixels(data, header, channel)
    except (struct.error, zlib.error) as error:
        raise ValueError(DAMAGED) from error


def _header(data: bytes) -> _Header:
    try:
        return _parse_header(data)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError(DAMAGED) from error


def _parse_header(data: bytes) -> _Header:
    (flags,) = struct.unpack_from("<I", data, 4)
    if data[:4] != MAGIC or flags & (TILED | MULTI_PART | DEEP):
        raise ValueError("not an OpenEXR file of scan lines in one part")
    start, attributes = 8, {}
    while data[start] != 0:
        name, start = _string(data, start)
        _, start = _string(data, start)
        (size,) = struct.unpack_from("<i", data, start)
        if not 0 <= size <= len(data) - start - 4:
            raise ValueError(DAMAGED)
        attributes[name] = data[start + 4 : start + 4 + size]
        start += 4 + size
    if not {"channels", "compression", "dataWindow"} <= attributes.keys():
        raise ValueError("an OpenEXR header without channels, compression or data window")
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if not 0 < min(width, height) <= max(width, height) <= MAX_SIDE or width * height > MAX_PIXELS:
        raise ValueError(f"an OpenEXR image of {width}×{height} pixels")
    compression = attributes["compression"][0]
    if compression not in LINES:
        raise ValueError(f"OpenEXR data with compression {compression}; only none, ZIPS and ZIP are supported")
    return _Header(_channels(attributes["channels"]), compression, width, height, top, start + 1)


def _string(data: bytes, start: int) -> tuple[str, int]:
    end = data.index(b"\0", start, start + 256) if b"\0" in data[start : start + 256] else -1
    if end < 0:
        raise ValueError(DAMAGED)
    return data[start:end].decode("ascii"), end + 1


def _channels(data: bytes) -> list[tuple[str, np.dtype]]:
    found: list[tuple[str, np.dtype]] = []
    start = 0
    while data[start] != 0:
        name, start = _string(data, start)
        kind, _, across, down = struct.unpack_from("<iIii", data, start)
        if kind not in PIXEL_TYPES or (across, down) != (1, 1):
            raise ValueError(f"an OpenEXR channel {name} that is subsampled or of unknown type")
        found.append((name, PIXEL_TYPES[kind]))
        start += 16
    if len(found) > MAX_CHANNELS or len(dict(found)) < len(found):
        raise ValueError(
            f"an OpenEXR file of {len(found)} channels, expected at most {MAX_CHANNELS} of different names"
        )
    return found


def _pixels(data: bytes, header: _Header, channel: str) -> Float[np.ndarray, "H W"]:
    names = [name for name, _ in header.channels]
    if channel not in names or dict(header.channels)[channel].kind != "f":
        raise ValueError(f"no floating-point channel {channel} among the OpenEXR channels {', '.join(names)}")
    line = np.dtype([(name, kind, (header.width,)) for name, kind in header.channels])
    blocks = _stored_blocks(data, header, line.itemsize)
    result = np.empty((header.height, header.width), np.float32)
    for row, stored in blocks.items():
        count = min(LINES[header.compression], header.height - row)
        result[row : row + count] = np.frombuffer(_block(stored, count * line.itemsize), line, count)[channel]
    return result


def _stored_blocks(data: bytes, header: _Header, line_size: int) -> dict[int, memoryview]:
    """The stored bytes of every block by its first row; there must be enough of them for the pixels of the header."""
    lines, view = LINES[header.compression], memoryview(data)
    blocks: dict[int, memoryview] = {}
    for offset in struct.unpack_from(f"<{-(-header.height // lines)}Q", data, header.end):
        y, size = struct.unpack_from("<ii", data, offset) if offset < len(data) else (header.top - 1, 0)
        row = y - header.top
        if not 0 <= row < header.height or row % lines or row in blocks or not 0 < size <= len(data) - offset - 8:
            raise ValueError(DAMAGED)
        if min(lines, header.height - row) * line_size > MAX_RATIO * size:
            raise ValueError(DAMAGED)
        blocks[row] = view[offset + 8 : offset + 8 + size]
    if sum(map(len, blocks.values())) > len(data):  # one piece of it in many blocks
        raise ValueError(DAMAGED)
    return blocks


def _block(stored: memoryview, size: int) -> bytes | memoryview:
    """The bytes of a block: stored as they are if that is shorter; else differences of reordered bytes, deflated."""
    if len(stored) == size:
        return stored
    inflated = zlib.decompressobj().decompress(stored, size + 1)
    if len(inflated) != size:
        raise ValueError(DAMAGED)
    values = np.frombuffer(inflated, np.uint8).copy()
    values[1:] -= np.uint8(128)  # modulo 256, as the sums
    ordered = np.cumsum(values, dtype=np.uint8)
    result, half = np.empty(size, np.uint8), (size + 1) // 2
    result[0::2], result[1::2] = ordered[:half], ordered[half:]
    return result.data
