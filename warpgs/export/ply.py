"""Binary little-endian PLY files with rows of a fixed size: a text header, then one table after the other.

The reader checks the sizes in the header against the size of the file before it allocates anything.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from warpgs.files import read_bounded, write_bytes

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"},
    **{"float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"},
}
"""NumPy types of the property types of a PLY file, under their old and their new names."""

NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<u4": "uint"}
"""Property types that are written, by NumPy type."""

MAX_HEADER = 1 << 16
MAX_PROPERTIES = 256
MAX_FILE = 8 << 30
"""Maximum size of the header and of a file [bytes]."""

END = b"end_header\n"


def write_ply(path: Path, tables: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> int:
    """Writes structured arrays as elements of a PLY file, with comments; returns its size [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
    """
    lines = ["ply", "format binary_little_endian 1.0", "comment written by warpgs"]
    lines += [f"comment {comment}" for comment in comments]
    for element, table in tables.items():
        lines.append(f"element {element} {len(table)}")
        assert table.dtype.names
        lines += [f"property {NAMES[table.dtype[name].str]} {name}" for name in table.dtype.names]
    header = "\n".join(lines).encode("ascii") + b"\n" + END
    return write_bytes(path, [header, *(table.tobytes() for table in tables.values())])


def read_ply(path: Path) -> dict[str, np.ndarray]:
    """Reads the elements of a PLY file as structured arrays.

    Raises:
        ValueError: If it is not such a file, or damaged; the message names it.
    """
    data = read_bounded(path, MAX_FILE)
    end = data.find(END, 0, MAX_HEADER)
    text = data[:MAX_HEADER].replace(b"\r\n", b"\n")
    if not text.startswith(b"ply\n"):
        raise ValueError(f"{path} is not a PLY file")
    if end < 0:
        raise ValueError(f"{path} has no PLY header of Unix lines within its first {MAX_HEADER:,} bytes")
    tables, offset = {}, end + len(END)
    for name, (count, dtype) in _elements(path, data[:end]).items():
        size, left = count * dtype.itemsize, len(data) - offset
        if size > left:
            raise ValueError(f"{path} is truncated: {count:,} rows of {name} take {size:,} bytes, {left:,} are left")
        tables[name] = np.frombuffer(data, dtype, count, offset)
        offset += size
    if offset != len(data):
        raise ValueError(f"{path} is damaged: {len(data) - offset:,} bytes follow its last element")
    return tables


def _elements(path: Path, header: bytes) -> dict[str, tuple[int, np.dtype]]:
    """Number of rows and row type of each element that a header declares."""
    counts: dict[str, int] = {}
    columns: dict[str, list[tuple[str, str]]] = {}
    is_binary = False
    for line in header.decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", name, "1.0"]:
                is_binary = name == "binary_little_endian"
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                if name in counts:
                    raise ValueError(f"{path} has two elements named {name}")
                counts[name], columns[name] = int(count), []
            case ["property", type_name, name] if type_name in TYPES and columns:
                columns[next(reversed(columns))].append((name, TYPES[type_name]))
            case _:
                raise ValueError(f"{path} has a header line that is not supported: {line[:80]!r}")
    if not is_binary:
        raise ValueError(f"{path} is not in the format binary_little_endian 1.0")
    return {name: (counts[name], _row_type(path, name, columns[name])) for name in counts}


def _row_type(path: Path, element: str, columns: list[tuple[str, str]]) -> np.dtype:
    names = [name for name, _ in columns]
    if not 0 < len(names) <= MAX_PROPERTIES:
        raise ValueError(f"{path}: {element} has {len(names)} properties, expected 1 to {MAX_PROPERTIES}")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: {element} has two properties of the same name")
    return np.dtype(columns)


def column(path: Path, table: np.ndarray, name: str, kind: str = "f") -> np.ndarray:
    """A column of a table.

    Args:
        path: The file, for messages.
        table: Table of the file.
        name: Name of the property.
        kind: NumPy's letter for the kind of type expected, "f" for floats or "u" for unsigned integers.

    Raises:
        ValueError: If the column is missing or has another type; the message names the file.
    """
    if name not in (table.dtype.names or ()):
        raise ValueError(f"{path} has no property {name}: it does not hold Gaussians of 3DGS")
    if table.dtype[name].kind != kind:
        raise ValueError(f"{path}: {name} has the wrong type {table.dtype[name]}")
    return table[name]
