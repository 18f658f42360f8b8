"""Files that are whole or not there, and files that are read only if they are no longer than they may be."""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path


def partial_of(path: Path) -> Path:
    """Where a file is written before it has its name."""
    return path.with_name(path.name + ".partial")


@contextmanager
def beside(path: Path) -> Iterator[Path]:
    """A place to write a file to, which is moved to ``path`` at the end; after any error, Ctrl-C too, nothing is left.

    Raises:
        OSError: If it can't be written; the message names ``path``.
    """
    partial = partial_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise OSError(f"{path} could not be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            partial.unlink()


def write_whole(path: Path, parts: Iterable[bytes]) -> int:
    """Writes parts one after the other; returns their size [bytes].

    Raises:
        OSError: If the file can't be written; the message names it.
    """
    with beside(path) as partial, open(partial, "wb") as file:
        return sum(file.write(part) for part in parts)


def write_text(path: Path, text: str) -> None:
    """Writes a text.

    Raises:
        OSError: If the file can't be written; the message names it.
    """
    write_whole(path, [text.encode()])


def read_bounded(path: Path, most: int) -> bytes:
    """All of a file that is no longer than ``most`` bytes.

    Raises:
        ValueError: If it is no file (a device would never end), or longer; the message names it.
    """
    if not path.is_file():
        raise ValueError(f"{path} is no file")
    size = path.stat().st_size
    if size > most:
        raise ValueError(f"{path} has {size:,} bytes, more than the {most:,} that this program reads")
    return path.read_bytes()


def remove_numbered(folder: Path, name: Callable[[int], str]) -> None:
    """Removes the files that are called ``name(0)``, ``name(1)`` … up to the first that is not there."""
    for k in count():
        path = folder / name(k)
        if not path.is_file():
            return
        path.unlink()
