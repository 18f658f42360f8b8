"""Locks of folders into which several processes may write: run folders, captures, sweeps."""

import errno
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from .files import kept_if_used

WITHOUT_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP}
"""Errors of file systems without locks, such as NFS without a lock daemon."""

LOCK = ".lock"
"""File that a process which writes into a folder that others may write into, too, keeps locked; then it is removed."""


@contextmanager
def lock_folder(folder: Path, activity: str, bookkeeping: Collection[str] = ()) -> Iterator[None]:
    """Makes a folder, unless it exists, and locks it against other processes; the lock ends with the process.

    In the end, a folder that it made is removed again if nothing was written into it, as in ``kept_if_used``. On a file
    system without locks, nothing is locked.

    Args:
        folder: The folder.
        activity: What is done with it, for messages: "trained".
        bookkeeping: Names of files that alone are not worth keeping.

    Raises:
        ValueError: If another process holds the lock.
        OSError: If the folder or the file that is locked cannot be written.
    """
    with kept_if_used(folder, (*bookkeeping, LOCK)):
        lock = FileLock(folder / LOCK)
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise ValueError(
                f"{folder} is being {activity} by another process: wait until it has ended, or choose another folder"
            ) from error
        except (OSError, NotImplementedError) as error:
            if isinstance(error, OSError) and error.errno not in WITHOUT_LOCKS:
                raise
        try:
            yield
        finally:
            with suppress(OSError):  # as long as it is locked, so that no one else holds it; not on Windows
                (folder / LOCK).unlink()
            lock.release()
