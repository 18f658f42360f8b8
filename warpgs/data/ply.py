"""Points of PLY files: the vertices of ASCII or binary files, with their colours."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from warpgs.files import read_bounded

MAX_BYTES = 4 << 30
"""Maximum size of a file [bytes]."""

MAX_HEADER = 1 << 16
"""Maximum size of its header [bytes]."""

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply_points(path: Path) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]:
    """x, y, z of the vertices, and their red, green and blue if they are bytes.

    Raises:
        ValueError: If the file is missing, truncated or damaged, its first element is not ``vertex``, or a position is
            not finite.
    """
    data = read_bounded(path, MAX_BYTES)
    end = data.find(b"end_header", 0, MAX_HEADER)
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise ValueError(f"{path} is not a PLY file")
    order, count, layout = _header(path, data[:end].decode("ascii", "replace").split("\n"))
    if ORDERS[order]:
        if count * layout.itemsize > len(data) - start:
            raise ValueError(f"{path} is truncated: it claims {count:,} vertices")
        vertices = np.frombuffer(data, layout, count, start)
    else:
        vertices = _ascii(path, data[start:], count, layout)
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], -1)
    if not np.isfinite(points).all():
        raise ValueError(f"{path} has vertices that are not finite")
    channels = "red", "green", "blue"
    if not all(layout.fields and name in layout.fields and layout[name].str[1:] == "u1" for name in channels):
        return points, None
    return points, np.stack([vertices[name] for name in channels], -1)


def _header(path: Path, lines: list[str]) -> tuple[str, int, np.dtype]:
    """Encoding, number of vertices, and layout of a vertex."""
    order, count, fields, element = "", -1, [], ""
    for line in lines:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1 and words[1] in ORDERS:
            order = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if count < 0 and words[1] != "vertex":
                raise ValueError(f"{path}: its first element must be vertex, got {words[1]}")
            element = words[1]
            count = int(words[2]) if element == "vertex" and words[2].isdigit() else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                raise ValueError(f"{path}: a vertex has the property {line.strip()!r:.60}, which is not a number")
            fields.append((words[2], ORDERS.get(order, "") + TYPES[words[1]]))
    names = [name for name, _ in fields]
    if not order or count < 0 or len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise ValueError(f"{path}: its header must have a format and vertices with x, y and z")
    return order, count, np.dtype(fields)


def _ascii(path: Path, body: bytes, count: int, layout: np.dtype) -> np.ndarray:
    lines = body.split(b"\n", count)[:count]
    try:
        rows = [tuple(map(float, line.split())) for line in lines]
        if len(rows) < count or any(len(row) != len(layout.names or ()) for row in rows):
            raise ValueError("too few numbers")
        return np.array(rows, layout)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path} is truncated or damaged: it claims {count:,} vertices") from error
