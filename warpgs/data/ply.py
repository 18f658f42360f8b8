"""PLY files: a text header, then one table after the other, with rows of a fixed size or, as ASCII, a line per row.

The reader checks the sizes in the header against the size of the file before it allocates anything.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from warpgs.files import read_start, require_file

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
"""NumPy types of the property types of a PLY file, under their old and their new names."""

LITTLE = "binary_little_endian"

ORDERS = {"ascii": "", LITTLE: "<", "binary_big_endian": ">"}
"""NumPy's byte order of each format."""

MAX_HEADER = 1 << 16
MAX_PROPERTIES = 256
MAX_FILE = 8 << 30
"""Maximum size of the header and of a file [bytes]."""

MAX_TEXT = 40
"""Characters that a number of an ASCII file takes at most, with the space or the line break after it."""


@dataclass
class _Element:
    """An element that a header declares: number of rows, (name, type) of its columns, and a line that has a list."""

    count: int
    columns: list[tuple[str, str]] = field(default_factory=list)
    listed: str = ""


def read_ply(path: Path, formats: Collection[str] = (LITTLE,), *, first_only: bool = False) -> dict[str, np.ndarray]:
    """Reads the elements of a PLY file as structured arrays.

    Args:
        path: The file.
        formats: Formats that are read, of ``ORDERS``.
        first_only: Whether to read the first element only; others may then have lists, as faces have.

    Raises:
        ValueError: If it is not such a file, or damaged; the message names it.
    """
    size = require_file(path, MAX_FILE)
    header = read_start(path, MAX_HEADER)
    if not re.match(rb"ply\r?\n", header):
        raise ValueError(f"{path} is not a PLY file")
    end = re.search(rb"\nend_header\r?\n", header)
    if end is None:
        raise ValueError(f"{path} has no PLY header within its first {MAX_HEADER:,} bytes")
    order, elements = _elements(path, header[: end.start()], formats)
    chosen = [*elements.items()][: 1 if first_only else None]
    layouts = {name: _row_type(path, name, element, order) for name, element in chosen}
    # The rest of the file may be anything: of a file system that keeps no zeros, even 8 GB in a few KiB.
    rows = sum(
        element.count * (layouts[name].itemsize if order else MAX_TEXT * len(element.columns))
        for name, element in chosen
    )
    data = read_start(path, min(size, end.end() + rows))
    tables, offset = {}, end.end()
    for name, element in chosen:
        tables[name], offset = (_rows if order else _lines)(path, name, element.count, layouts[name], data, offset)
    if offset != size and not first_only:
        raise ValueError(f"{path} is damaged: {size - offset:,} bytes follow its last element")
    return tables


def read_ply_points(path: Path) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]:
    """x, y, z of the vertices of a file of any format, and their red, green and blue if they are bytes.

    Raises:
        ValueError: If the file is missing, truncated or damaged, its first element is not ``vertex``, or a position is
            not finite.
    """
    tables = read_ply(path, ORDERS, first_only=True)
    if "vertex" not in tables:
        raise ValueError(f"{path}: its first element must be vertex, got {', '.join(tables) or 'none'}")
    vertices = tables["vertex"]
    layout = vertices.dtype
    assert layout.fields is not None
    if not {"x", "y", "z"} <= layout.fields.keys():
        raise ValueError(f"{path}: its vertices must have x, y and z")
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], -1)
    if not np.isfinite(points).all():
        raise ValueError(f"{path} has vertices that are not finite")
    channels = "red", "green", "blue"
    if not all(name in layout.fields and layout[name].str[1:] == "u1" for name in channels):
        return points, None
    return points, np.stack([vertices[name] for name in channels], -1)


def _elements(path: Path, header: bytes, formats: Collection[str]) -> tuple[str, dict[str, _Element]]:
    """Byte order, and the elements that a header declares."""
    elements: dict[str, _Element] = {}
    format_name = ""
    for line in header.decode("latin-1").split("\n")[1:]:
        last = elements[next(reversed(elements))] if elements else None
        match line.split():
            case ["format", name, "1.0"]:
                format_name = name
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                if name in elements:
                    raise ValueError(f"{path} has two elements named {name}")
                elements[name] = _Element(int(count))
            case ["property", type_name, name] if type_name in TYPES and last is not None:
                last.columns.append((name, TYPES[type_name]))
            case ["property", "list", *_] if last is not None:
                last.listed = line
            case _:
                raise ValueError(f"{path} has a header line that is not supported: {line[:80]!r}")
    if format_name not in formats:
        raise ValueError(f"{path} is not in the format {' or '.join(formats)} 1.0")
    return ORDERS[format_name], elements


def _row_type(path: Path, name: str, element: _Element, order: str) -> np.dtype:
    names = [column for column, _ in element.columns]
    if element.listed:
        raise ValueError(f"{path} has a header line that is not supported: {element.listed[:80]!r}")
    if not 0 < len(names) <= MAX_PROPERTIES:
        raise ValueError(f"{path}: {name} has {len(names)} properties, expected 1 to {MAX_PROPERTIES}")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: {name} has two properties of the same name")
    return np.dtype([(column, order + kind) for column, kind in element.columns])


def _rows(path: Path, name: str, count: int, layout: np.dtype, data: bytes, offset: int) -> tuple[np.ndarray, int]:
    """The rows of a binary element, and where they end."""
    size, left = count * layout.itemsize, len(data) - offset
    if size > left:
        raise ValueError(f"{path} is truncated: {count:,} rows of {name} take {size:,} bytes, {left:,} are left")
    return np.frombuffer(data, layout, count, offset), offset + size


def _lines(path: Path, name: str, count: int, layout: np.dtype, data: bytes, offset: int) -> tuple[np.ndarray, int]:
    """The rows of an ASCII element, and where they end."""
    lines = data[offset:].split(b"\n", count)[:count]
    try:
        rows = [tuple(map(float, line.split())) for line in lines]
        if len(rows) < count or any(len(row) != len(layout.names or ()) for row in rows):
            raise ValueError("too few numbers")
        return np.array(rows, layout), offset + sum(len(line) + 1 for line in lines)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path} is truncated or damaged: it claims {count:,} rows of {name}") from error
