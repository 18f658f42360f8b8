"""Arrays of .npz files, with sizes that are checked before anything is decompressed."""

import io
from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from warpgs.files import DAMAGED_ARRAY

from .archive import Archive

MAX_BYTES = 8 << 30
"""Maximum size of an .npz file, and of its arrays together [bytes]."""


def names_of(path: Path) -> set[str]:
    """Names of the arrays of an .npz file; raises ``ValueError`` if it is missing, damaged or too large."""
    return {member.removesuffix(".npy") for member in Archive(path, MAX_BYTES).sizes}


def read_npz(path: Path, names: Collection[str], max_bytes: int = MAX_BYTES) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Arrays of numbers of an .npz file; pickled objects are refused.

    Args:
        path: The file.
        names: Arrays to read; the others may be anything.
        max_bytes: Maximum size of these arrays together.

    Raises:
        ValueError: If the file or an array is missing, damaged or larger, or holds something other than numbers.
    """
    archive = Archive(path, MAX_BYTES)
    members = {member.removesuffix(".npy"): member for member in archive.sizes}
    if missing := [name for name in names if name not in members]:
        raise ValueError(f"{path} has no array {missing[0]}")
    size = sum(archive.sizes[members[name]] for name in names)
    if size > max_bytes:
        raise ValueError(f"{path}: its arrays have {size:,} bytes, more than the maximum of {max_bytes:,}")
    return {name: _parse(path, members[name], archive.read(members[name], max_bytes)) for name in names}


def _parse(path: Path, name: str, data: bytes) -> np.ndarray:
    try:
        file = io.BytesIO(data)
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read_header(file)
        count = int(np.prod(shape, dtype=object))
        if dtype.kind not in "fiub" or dtype.itemsize > 8 or count * dtype.itemsize > len(data) - file.tell():
            raise ValueError("not an array of numbers of the file's size")
        return np.frombuffer(data, dtype, count, file.tell()).reshape(shape, order="F" if fortran else "C")
    except DAMAGED_ARRAY as error:
        raise ValueError(f"{path}: {name} is damaged or not an array of numbers") from error
