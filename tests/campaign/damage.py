"""Damage to files: what disks, transfers and users do to them."""

import os
import random
import re
import resource
import signal
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

MAX_SECONDS, MAX_KIB = 20.0, 2 << 20
"""Bounds of every command: seconds, and growth of the resident memory."""

MAX_READING_SECONDS, MAX_READING_KIB = 5.0, 1 << 20
"""Bounds of reading files of a few KiB."""

INTERESTING = (b"\xff" * 8, b"\0" * 8, b"\0\0\0\0\0\0\xf8\x7f", b"1e300", b"-1", b"null", b"[[[[", b'"', b"\x1b[2J")
"""The third is a NaN."""


def flip(data: bytearray, r: random.Random) -> None:
    data[r.randrange(len(data))] ^= 1 << r.randrange(8)


def overwrite(data: bytearray, r: random.Random) -> None:
    start, piece = r.randrange(len(data)), r.choice([*INTERESTING, r.randbytes(8)])
    data[start : start + len(piece)] = piece


def cut(data: bytearray, r: random.Random) -> None:
    del data[r.randrange(len(data)) :]


def insert(data: bytearray, r: random.Random) -> None:
    start = r.randrange(len(data))
    data[start:start] = r.choice([*INTERESTING, r.randbytes(r.randrange(1, 40))])


def remove(data: bytearray, r: random.Random) -> None:
    start = r.randrange(len(data))
    del data[start : start + r.randrange(1, 40)]


NUMBERS = (
    *(b"9" * 400, b"9" * 5000, b"-" + b"9" * 400, b"0x" + b"f" * 300, b"1" + b"0" * 25, b"18446744073709551616"),
    *(b"9223372036854775807", b"4294967295", b"65536", b"16384", b"1e999", b"-1e308", b"1e30", b"1e-320", b"nan"),
    *(b"inf", b"NaN", b"Infinity", b"-0", b"0", b"1.5", b"true", b"null", b'"1"', b"[1]", b"{}", b"1_000"),
)
"""Numbers, and what may stand in their place in a text."""


def exaggerate(data: bytearray, r: random.Random) -> None:
    """Replaces a number of a text; one of a binary file only by chance."""
    if found := list(re.finditer(rb"-?\d[\d.e+-]*", data)):
        start, end = r.choice(found).span()
        data[start:end] = r.choice(NUMBERS)


def repeat(data: bytearray, r: random.Random) -> None:
    """Repeats a line, or a few bytes, up to thousands of times."""
    start = r.randrange(len(data))
    line = data.rfind(b"\n", 0, start) + 1, data.find(b"\n", start) + 1
    start, end = line if line[1] and r.random() < 0.5 else (start, start + r.randrange(1, 8))
    data[start:start] = data[start:end] * min(r.choice((1, 1, 10, 20_000)), 400_000 // (end - start))


CHANGES: list[Callable[[bytearray, random.Random], None]] = [flip, flip, overwrite, cut, insert, remove]
TEXT_CHANGES = [*CHANGES, exaggerate, exaggerate, exaggerate, exaggerate, repeat]


def replace_by_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def replace_by_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def replace_by_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def replace_by_memory(path: Path) -> None:
    """Size 0, and reading fails."""
    path.unlink()
    path.symlink_to("/proc/self/mem")


def replace_by_status(path: Path) -> None:
    """Size 0, with content."""
    path.unlink()
    path.symlink_to("/proc/self/status")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def enlarge(path: Path) -> None:
    os.truncate(path, 8 << 30)


KINDS: list[Callable[[Path], None]] = [
    *(Path.unlink, replace_by_fifo, replace_by_device, replace_by_folder, enlarge),
    *(replace_by_itself, replace_by_memory, replace_by_status, empty),
]

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


def damage_member(path: Path, r: random.Random) -> None:
    """Damages a file in an archive, whose checksum is then right, and compresses it in one of many ways."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen, method = r.choice(sorted(members)), r.choice(METHODS)
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, damaged(content, r) if name == chosen else content)


def damaged(content: bytes, r: random.Random) -> bytes:
    """A content after some changes."""
    data = bytearray(content)
    for _ in range(r.choice([1, 1, 1, 3, 10])):
        if data:
            r.choice(TEXT_CHANGES)(data, r)
    return bytes(data)


def damage(path: Path, r: random.Random) -> None:
    """Damages a file in one of many ways."""
    if r.random() < 0.08:
        r.choice(KINDS)(path)
        return
    if path.suffix in (".zip", ".npz") and r.random() < 0.6:
        damage_member(path, r)
    else:
        path.write_bytes(damaged(path.read_bytes(), r))


class Hang(BaseException):
    """Something takes far too long; not an Exception, so that nothing but a test catches it."""


@contextmanager
def bounded(what: str, seconds: float = MAX_SECONDS, kib: int = MAX_KIB) -> Iterator[None]:
    """Checks the processor time and the growth of the resident memory of what happens inside, and ends what hangs."""

    def stop(*_: object) -> None:
        raise Hang(what)

    start, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(int(10 * seconds))  # real time, on a machine that may have other work
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert time.process_time() - start < seconds, what
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < kib, what


def refusal(read: Callable[[], object]) -> str | None:
    """The message with which something is refused, after checks of its time, memory and form; None if it is accepted.

    Any error but a ValueError is raised.
    """
    message = None
    with bounded("reading", MAX_READING_SECONDS, MAX_READING_KIB):
        try:
            read()
        except ValueError as error:
            message = str(error)
    assert message is None or "\n" not in message
    return message
