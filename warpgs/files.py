"""Reading and writing files: atomic writes, bounded reads, JSON, PNG and .npy.

Every error names the file: writing functions raise an OSError if it cannot be written.
"""

import glob
import io
import json
import os
import re
import reprlib
import shutil
import stat
import tempfile
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from errno import ENAMETOOLONG
from itertools import count, takewhile
from pathlib import Path
from tokenize import TokenError
from typing import Any

import cv2
import numpy as np
from filelock import FileLock, Timeout
from jaxtyping import Float, Shaped, UInt

from . import posix
from .parsed import finite, parse_json

MAX_JSON = 64 << 20
"""Maximum size of a JSON file [bytes]; metadata.json of a long capture has a few MiB."""

MAX_NUMBER = 1e9
"""Maximum magnitude of a position, a focal length or another measured number in a file: larger ones are damage, and
their products overflow in single precision."""

OWNED = ".warpgs.lock"
"""File that the process which writes a temporary folder keeps locked."""


MAX_NPY_HEADER = 1 << 20
"""Maximum size of what precedes the numbers of a .npy file [bytes]."""

DAMAGED_ARRAY = (
    *(ValueError, OSError, EOFError, OverflowError, TypeError, SyntaxError, TokenError),
    *(RecursionError, MemoryError),  # a header is parsed as Python, whose parser has a stack of limited size
)
"""Errors of NumPy for a damaged .npy file."""


def first_file(paths: Iterable[Path]) -> Path | None:
    """The first of some paths that is a file; a name that the file system refuses is none."""
    return next((path for path in paths if is_file(path)), None)


def is_file(path: Path) -> bool:
    """Whether a path is a file; one with a name that is too long for the file system is none."""
    try:
        return path.is_file()
    except OSError as error:
        if error.errno != ENAMETOOLONG:
            raise
        return False


def natural_order(name: str) -> tuple[list[str | tuple[int, str]], str]:
    """Key that sorts names with numbers by their values: shot2 before shot10.

    Numbers stay text, compared by length and digits: ``int`` refuses very long ones, which a damaged file may hold.
    """
    parts = re.split(r"([0-9]+)", name)  # text and numbers alternate
    digits = [part.lstrip("0") for part in parts]
    return [(len(digits[k]), digits[k]) if k % 2 else part for k, part in enumerate(parts)], name


def partial_path(path: Path) -> Path:
    """The temporary path that a file is written to before it is renamed."""
    return path.with_name(path.name + ".partial")


def reworded(error: OSError, message: str) -> OSError:
    """An error of the same number and built-in class with another message."""
    # The constructors of other classes, such as PyAV's, may take something else than a message.
    classes = (kind for kind in type(error).__mro__ if kind.__module__ == "builtins" and issubclass(kind, OSError))
    renamed: OSError = next(classes)(message)
    renamed.errno = error.errno
    return renamed


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path to write to: renamed to ``path`` on success, removed after any error or Ctrl-C.

    Raises:
        OSError: If the file cannot be written; the message names ``path``. Its class and errno are those of the cause.
    """
    partial = partial_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise reworded(error, f"{path} could not be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            partial.unlink()


@contextmanager
def complete_or_absent(folder: Path, keep_existing: bool = False) -> Iterator[Path]:
    """A temporary folder to write to: renamed to ``folder`` on success, removed after any error or Ctrl-C.

    Args:
        folder: The folder, which does not exist or is empty.
        keep_existing: Whether another process may make the same folder meanwhile, which is kept then.

    Raises:
        ValueError: If another process is writing it, unless ``keep_existing``.
        OSError: If it cannot be created, or is not empty at the end; the message names the folder or its parent, as do
            those of errors of files in it, instead of the temporary folder. Its class and errno are those of the cause.
    """
    if _remove_abandoned(folder) and not keep_existing:
        raise ValueError(f"{folder} is being written by another process: wait until it has ended, or choose another")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
    except OSError as error:
        raise reworded(error, f"{folder.name} cannot be kept in {folder.parent}: {error.strerror}") from error
    partial = beside / folder.name  # only its owner may open ``beside``
    try:
        with _locked(beside):
            partial.mkdir()
            yield partial
            try:
                with suppress(OSError):  # Windows renames to nothing that exists
                    folder.rmdir()
                partial.rename(folder)
            except OSError:
                if not (keep_existing and folder.is_dir()):
                    raise
    except OSError as error:
        if str(beside) not in str(error):
            raise
        # The temporary name would make equal errors of two attempts differ, and nobody finds that folder afterwards.
        message = str(error).replace(str(partial), str(folder)).replace(str(beside), str(folder))
        raise reworded(error, message) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


@contextmanager
def kept_if_used(folder: Path, bookkeeping: Collection[str] = ()) -> Iterator[None]:
    """Makes a folder, with its parents, and removes what it has made of them if nothing was written there in the end.

    Args:
        folder: The folder; one that exists is kept as it is.
        bookkeeping: Names of files that alone are not worth keeping.

    Raises:
        OSError: If the folder cannot be made.
    """
    made = [folder, *(parent for parent in folder.parents if not parent.exists())]
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir()  # at once whether it is new: another process may make it, too
    except FileExistsError:
        if not folder.is_dir():
            raise
        made = []
    try:
        yield
    finally:
        with suppress(OSError):  # of folders that are not empty
            if made and {path.name for path in folder.iterdir()} <= set(bookkeeping):
                for path in folder.iterdir():
                    path.unlink()
            for path in made:
                path.rmdir()


def _remove_abandoned(folder: Path) -> bool:
    """Removes what processes that were killed in ``complete_or_absent`` left of a folder; others hold their locks.

    Returns:
        Whether another process holds one.
    """
    is_written = False
    for partial in folder.parent.glob(f".{glob.escape(folder.name)}-*/{glob.escape(folder.name)}"):
        lock = partial.parent / OWNED
        if lock.is_file() and not lock.is_symlink():  # opening it may empty it
            try:
                with FileLock(lock, timeout=0):
                    shutil.rmtree(partial)
            except Timeout:  # an OSError, too
                is_written = True
            except (OSError, NotImplementedError):
                pass
            if not partial.exists():
                shutil.rmtree(partial.parent, ignore_errors=True)
    return is_written


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Locks a temporary folder of this process, before there is anything in it, as long as the process lives."""
    lock = FileLock(folder / OWNED)
    with suppress(NotImplementedError):  # a file system without locks
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def write_bytes(path: Path, parts: Iterable[bytes]) -> int:
    """Writes ``parts`` one after the other; returns the size of the file [bytes]."""
    with atomic_path(path) as partial, open(partial, "wb") as file:
        return sum(file.write(part) for part in parts)


def write_text(path: Path, text: str) -> None:
    """Writes a text as UTF-8."""
    write_bytes(path, [text.encode()])


def write_json(path: Path, values: Any) -> None:
    """Writes values as JSON; numbers that are not finite become null, which every reader understands."""
    write_text(path, json.dumps(finite(values), indent=2) + "\n")


def write_png(path: Path, image: UInt[np.ndarray, "H W"] | UInt[np.ndarray, "H W C"]) -> None:
    """Writes a greyscale, RGB or RGBA image of 8 or 16 bits."""
    try:
        data = encode_png(image)
    except ValueError as error:
        raise OSError(f"{path} could not be encoded") from error
    write_bytes(path, [data])


def encode_png(image: UInt[np.ndarray, "H W"] | UInt[np.ndarray, "H W C"]) -> bytes:
    """A PNG file of a greyscale, RGB or RGBA image of 8 or 16 bits.

    Raises:
        ValueError: If it cannot be encoded.
    """
    order = [2, 1, 0, 3][: image.shape[-1]]  # OpenCV's
    encoded, data = cv2.imencode(".png", image[..., order] if image.ndim == 3 else image)
    if not encoded:
        raise ValueError("the image could not be encoded as PNG")
    return bytes(data.tobytes())


def write_array(path: Path, values: Shaped[np.ndarray, "..."]) -> None:
    """Writes an array as .npy."""
    data = io.BytesIO()  # np.save to a file hides why it failed
    np.save(data, values)
    write_bytes(path, [data.getvalue()])


def require_file(path: Path, max_bytes: int, hint: str = "") -> int:
    """Checks a file before a library opens it by its path: a FIFO would never open, and a device never end.

    The message about a missing file says by ``hint`` why it is needed.

    Returns:
        The size of the file [bytes].

    Raises:
        ValueError: If it is missing, not a regular file or larger; the message names it.
    """
    try:
        info = path.stat()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ValueError(f"{path} is missing{': ' + hint if hint else ''}") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise ValueError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from error
    if not stat.S_ISREG(info.st_mode):
        raise ValueError(f"{path} is not a file")
    if info.st_size > max_bytes:
        raise ValueError(f"{path} has {info.st_size:,} bytes, more than the maximum of {max_bytes:,}")
    if info.st_size == 0:
        _require_empty(path)
    return info.st_size


def _require_empty(path: Path) -> None:
    """Refuses a file that states no size but has content, or cannot be read: such files of /proc may never end."""
    try:
        with open(os.open(path, posix.NONBLOCKING), "rb", buffering=0) as file:
            content = file.read(1)  # None if it would have to wait
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    if content != b"":
        raise ValueError(f"{path} is not a plain file: it has content, but its size is 0")


def read_bounded(path: Path, max_bytes: int, hint: str = "") -> bytes:
    """The content of a regular file of at most ``max_bytes``; arguments as for ``require_file``.

    Raises:
        ValueError: If it is missing, not a regular file (a device would never end) or larger; the message names it.
    """
    size = require_file(path, max_bytes, hint)
    data = read_start(path, size + 1)
    if len(data) != size:
        raise ValueError(f"{path} changes while it is read: expected {size:,} bytes")
    return data


def read_start(path: Path, max_bytes: int) -> bytes:
    """The first ``max_bytes`` of a file that ``require_file`` accepted, or all of it.

    Raises:
        ValueError: If it cannot be read; the message names it.
    """
    try:
        with path.open("rb") as file:
            return file.read(max_bytes)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error


def read_json(path: Path, hint: str = "", max_bytes: int = MAX_JSON) -> dict[str, Any]:
    """A JSON object.

    Raises:
        ValueError: If the file is missing or too large, is not JSON, or holds something other than an object.
    """
    return parse_json(path, read_bounded(path, max_bytes, hint))


_parsing_headers = threading.Lock()
"""Python before 3.11.8 and 3.12.2 counts the recursion of all parsers together: two at once end in a SystemError."""


def read_array(path: Path, max_values: int) -> Shaped[np.ndarray, "..."]:
    """A .npy file of at most ``max_values`` numbers of up to 8 bytes; pickled objects are refused.

    Raises:
        ValueError: If the file is missing, truncated or larger, or holds something other than numbers.
    """
    require_file(path, MAX_NPY_HEADER + 8 * max_values)
    try:
        with _parsing_headers, np.errstate(over="ignore"):  # the product of the sides that a header claims
            array = np.load(path, mmap_mode="r", allow_pickle=False)  # allocates nothing, whatever the header claims
    except DAMAGED_ARRAY as error:
        raise ValueError(f"{path} is damaged or not a .npy file of numbers") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise ValueError(f"{path} must be a .npy file of numbers")
    if array.size > max_values:
        raise ValueError(f"{path} has {array.size} numbers, more than the maximum of {max_values}")
    return np.array(array)


def read_numbers(path: Path, fields: dict[str, Any], key: str, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Numbers in a field of a JSON object, as an array of double precision.

    Args:
        path: The file that the object comes from, for messages.
        fields: The object.
        key: Name of the field.
        shape: Expected shape; () for a single number.

    Raises:
        ValueError: If the field is missing, or holds something other than finite numbers of this shape, at most
            ``MAX_NUMBER`` in magnitude.
    """
    if key not in fields:
        raise ValueError(f"{path} has no {key}")
    try:
        values = np.array(fields[key])
    except (ValueError, RecursionError) as error:  # lists of different lengths, or too deep
        raise ValueError(f"{path}: {key} must hold numbers, got {reprlib.repr(fields[key])}") from error
    if values.dtype.kind not in "fiu":  # objects are integers of too many digits, too
        raise ValueError(f"{path}: {key} must hold numbers, got {reprlib.repr(fields[key])}")
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(
            f"{path}: {key} must be finite numbers of shape {list(shape)}, got {reprlib.repr(fields[key])}"
        )
    if values.size and np.abs(values).max() > MAX_NUMBER:
        raise ValueError(f"{path}: {key} must be at most {MAX_NUMBER:g} in magnitude, got {values.tolist()}")
    return values.astype(np.float64)


def remove_numbered(folder: Path, name: Callable[[int], str]) -> list[Path]:
    """Removes the files ``name(0)``, ``name(1)`` … up to the first that does not exist; returns them."""
    removed = [*takewhile(Path.is_file, (folder / name(k) for k in count()))]
    for path in removed:
        path.unlink()
    return removed
