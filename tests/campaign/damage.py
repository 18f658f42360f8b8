"""Damage to files: what disks, transfers and users do to them."""

import os
import random
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

MAX_SECONDS, MAX_KIB = 20.0, 2 << 20
"""Bounds of every refusal: seconds, and growth of the resident memory."""

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


CHANGES: list[Callable[[bytearray, random.Random], None]] = [flip, flip, overwrite, cut, insert, remove]


def replace_by_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def replace_by_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def enlarge(path: Path) -> None:
    os.truncate(path, 8 << 30)


KINDS: list[Callable[[Path], None]] = [Path.unlink, replace_by_fifo, replace_by_device, replace_by_folder, enlarge]


def damage(path: Path, r: random.Random) -> None:
    """Damages a file in one of many ways."""
    if r.random() < 0.08:
        r.choice(KINDS)(path)
        return
    data = bytearray(path.read_bytes())
    for _ in range(r.choice([1, 1, 1, 3, 10])):
        if data:
            r.choice(CHANGES)(data, r)
    path.write_bytes(data)


class Hang(BaseException):
    """Something takes far too long; not an Exception, so that nothing but a test catches it."""


@contextmanager
def bounded(what: str) -> Iterator[None]:
    """Checks the processor time and the growth of the resident memory of what happens inside, and ends what hangs."""

    def stop(*_: object) -> None:
        raise Hang(what)

    start, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(int(10 * MAX_SECONDS))  # real time, on a machine that may have other work
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert time.process_time() - start < MAX_SECONDS, what
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < MAX_KIB, what


def refusal(read: Callable[[], object]) -> str | None:
    """The message with which something is refused, after checks of its time, memory and form; None if it is accepted.

    Any error but a ValueError is raised.
    """
    message = None
    with bounded("reading"):
        try:
            read()
        except ValueError as error:
            message = str(error)
    assert message is None or "\n" not in message
    return message
