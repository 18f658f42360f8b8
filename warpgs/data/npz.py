"""Arrays of .npz files, with sizes that are checked before anything is decompressed."""

import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from tokenize import TokenError

import numpy as np
from jaxtyping import Shaped

from warpgs.files import require_file

MAX_BYTES = 8 << 30
"""Maximum size of an .npz file, and of its arrays together [bytes]."""


def read_npz(path: Path, names: Collection[str], max_bytes: int = MAX_BYTES) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Arrays of numbers of an .npz file; pickled objects are refused.

    Args:
        path: The file.
        names: Arrays to read; the others may be anything.
        max_bytes: Maximum size of these arrays together.

    Raises:
        ValueError: If the file or an array is missing, damaged or larger, or holds something other than numbers.
    """
    require_file(path, MAX_BYTES)
    try:
        with zipfile.ZipFile(path) as archive:
            found = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if missing := [name for name in names if name not in found]:
                raise ValueError(f"{path} has no array {missing[0]}")
            size = sum(found[name].file_size for name in names)
            if size > max_bytes:
                raise ValueError(f"{path}: its arrays have {size:,} bytes, more than the maximum of {max_bytes:,}")
            return {name: _read(path, archive, found[name]) for name in names}
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged or not an .npz file: {error}") from error


def _read(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    try:
        with archive.open(info) as file:
            version = np.lib.format.read_magic(file)
            read_header = (
                np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            )
            shape, fortran, dtype = read_header(file)
            count = int(np.prod(shape, dtype=object))
            if dtype.kind not in "fiub" or dtype.itemsize > 8 or count * dtype.itemsize > info.file_size:
                raise ValueError("not an array of numbers of the file's size")
            data = file.read(count * dtype.itemsize)
            return np.frombuffer(data, dtype, count).reshape(shape, order="F" if fortran else "C")
    except (ValueError, TypeError, SyntaxError, TokenError, OverflowError) as error:
        raise ValueError(f"{path}: {info.filename} is damaged or not an array of numbers") from error
