"""Files that are whole or not there."""

import os
from collections.abc import Iterable
from pathlib import Path


def write_whole(path: Path, parts: Iterable[bytes]) -> int:
    """Writes parts one after the other beside the file's place, and moves the whole there; returns its size [bytes].

    Raises:
        OSError: If it can't be written; the message names the file.
    """
    partial = path.with_name(path.name + ".partial")
    size = 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as file:
            for part in parts:
                size += file.write(part)
        os.replace(partial, path)
    except OSError as error:
        raise OSError(f"{path} could not be written: {error.strerror or error}") from error
    finally:
        if partial.is_file():  # also after Ctrl-C
            partial.unlink()
    return size


def read_bounded(path: Path, most: int) -> bytes:
    """All of a file that is no longer than ``most`` bytes.

    Raises:
        ValueError: If it does not exist or is longer; the message names it.
    """
    if not path.is_file():
        raise ValueError(f"{path} is no file")
    size = path.stat().st_size
    if size > most:
        raise ValueError(f"{path} has {size:,} bytes, more than the {most:,} that this program reads")
    return path.read_bytes()
