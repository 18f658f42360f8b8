"""Writes binary little-endian PLY files with rows of a fixed size; takes columns of those that ``data.ply`` reads."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from warpgs.files import write_bytes

NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<u4": "uint"}
"""Property types that are written, by NumPy type."""

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


def column(path: Path, table: np.ndarray, name: str, kind: str = "f") -> np.ndarray:
    """A column of a table, of a kind of NumPy's: "f" for floats or "u" for unsigned integers.

    Raises:
        ValueError: If the column is missing or has another type; the message names the file.
    """
    if name not in (table.dtype.names or ()):
        raise ValueError(f"{path} has no property {name}: it does not hold Gaussians of 3DGS")
    if table.dtype[name].kind != kind:
        raise ValueError(f"{path}: {name} has the wrong type {table.dtype[name]}")
    return table[name]
