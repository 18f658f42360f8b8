"""PLY files of fixed rows: a header in words, then one table after the other, binary and little endian.

The reader takes nothing on trust: what a header claims must be what the file holds before anything is allocated.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warpgs.files import read_bounded, write_bytes

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"},
    **{"float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"},
}
"""Names of the types of a PLY file, old and new."""

NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<u4": "uint"}
"""Names of the types that are written."""

LONGEST_HEADER = 1 << 16
MAX_PROPERTIES = 256
MAX_FILE = 8 << 30
END = b"end_header\n"


def write_ply(path: Path, tables: Mapping[str, np.ndarray]) -> int:
    """Writes structured arrays as elements of a PLY file; returns its size [bytes].

    Raises:
        OSError: If it can't be written; the message names the file.
    """
    lines = ["ply", "format binary_little_endian 1.0", "comment written by warpgs"]
    for element, table in tables.items():
        lines.append(f"element {element} {len(table)}")
        assert table.dtype.names
        lines += [f"property {NAMES[table.dtype[name].str]} {name}" for name in table.dtype.names]
    header = "\n".join(lines).encode("ascii") + b"\n" + END
    return write_bytes(path, [header, *(table.tobytes() for table in tables.values())])


def read_ply(path: Path) -> dict[str, np.ndarray]:
    """The elements of a PLY file as structured arrays.

    Raises:
        ValueError: If it is no such file, or damaged; the message names it.
    """
    data = read_bounded(path, MAX_FILE)
    end = data.find(END, 0, LONGEST_HEADER)
    text = data[:LONGEST_HEADER].replace(b"\r\n", b"\n")
    if not text.startswith(b"ply\n"):
        raise ValueError(f"{path} is no PLY file")
    if end < 0:
        raise ValueError(f"{path} has no PLY header of Unix lines within its first {LONGEST_HEADER:,} bytes")
    tables, offset = {}, end + len(END)
    for name, (count, dtype) in _elements(path, data[:end]).items():
        size = count * dtype.itemsize  # exact: Python's integers
        if size > len(data) - offset:
            left = len(data) - offset
            raise ValueError(f"{path} is cut short: {count:,} rows of {name} take {size:,} bytes, {left:,} are left")
        tables[name] = np.frombuffer(data, dtype, count, offset)
        offset += size
    if offset != len(data):
        raise ValueError(f"{path} is damaged: {len(data) - offset:,} bytes follow its last element")
    return tables


def _elements(path: Path, header: bytes) -> dict[str, tuple[int, np.dtype]]:
    """Rows and type of each element that a header declares."""
    counts: dict[str, int] = {}
    columns: dict[str, list[tuple[str, str]]] = {}
    is_binary = False
    for line in header.decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", form, "1.0"]:
                is_binary = form == "binary_little_endian"
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                if name in counts:
                    raise ValueError(f"{path} has two elements named {name}")
                counts[name], columns[name] = int(count), []
            case ["property", kind, name] if kind in TYPES and columns:
                columns[next(reversed(columns))].append((name, TYPES[kind]))
            case _:
                raise ValueError(f"{path} has a header line that this program does not read: {line[:80]!r}")
    if not is_binary:
        raise ValueError(f"{path} is not in the form binary_little_endian 1.0")
    return {name: (counts[name], _row(path, name, columns[name])) for name in counts}


def _row(path: Path, element: str, columns: list[tuple[str, str]]) -> np.dtype:
    names = [name for name, _ in columns]
    if not 0 < len(names) <= MAX_PROPERTIES:
        raise ValueError(f"{path}: {element} has {len(names)} properties, expected 1 to {MAX_PROPERTIES}")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: {element} has two properties of the same name")
    return np.dtype(columns)


def column(path: Path, table: np.ndarray, name: str, kinds: str = "f") -> np.ndarray:
    """A column of a table, whose type is of one of ``kinds`` (numpy's letters).

    Raises:
        ValueError: If there is none or it has another type; the message names the file.
    """
    if name not in (table.dtype.names or ()):
        raise ValueError(f"{path} has no property {name}: it holds no Gaussians of 3DGS")
    if table.dtype[name].kind not in kinds:
        raise ValueError(f"{path}: {name} has the type {table.dtype[name]}, which is not the one it should have")
    return table[name]
