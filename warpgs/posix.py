"""What only some operating systems can do, in one place; elsewhere these functions do nothing.

The linter refuses such calls in all other modules.
"""

import ctypes
import os
import select
import signal
import subprocess
import sys
from typing import Any

PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl: the signal that a process gets when its parent dies."""


M_ARENA_MAX = -8
"""Option of glibc's mallopt: the maximum number of its pools of memory."""

NONBLOCKING = getattr(os, "O_NONBLOCK", 0)
"""Flag with which opening and reading a file never waits; 0 on Windows, which has no such files."""


def lower_priority(niceness: int) -> None:
    """Lets other processes have the processor first; not on Windows."""
    if hasattr(os, "nice"):
        os.nice(niceness)


def end_with_parent(parent: int) -> bool:
    """Lets this process be killed when its parent, given by its process id, dies, on Linux.

    Returns:
        Whether the parent was still alive.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    return os.getppid() == parent


def share_free_memory() -> None:
    """Lets all threads take memory from one pool, with glibc; by default each may keep free memory of its own."""
    if sys.platform == "linux" and (option := getattr(ctypes.CDLL(None), "mallopt", None)):
        option(M_ARENA_MAX, 1)


def release_free_memory() -> None:
    """Returns memory that the C library keeps for every thread after it ended to the system, with glibc."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)


def interrupt(process: subprocess.Popen[Any]) -> None:
    """Asks a child process to stop, as Ctrl-C does; on Windows, which cannot, it is ended."""
    if sys.platform == "win32":
        process.terminate()
    else:
        process.send_signal(signal.SIGINT)


def unblock_interrupts() -> None:
    """Lets SIGINT arrive, which a child inherits blocked from a parent that blocks it; not on Windows."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def block_termination() -> None:
    """Keeps SIGTERM from this thread, and from the processes that it starts, which inherit that; not on Windows."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])


def allow_interrupts() -> None:
    """Lets SIGINT arrive if it is ignored, as in everything that a shell started in the background."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def is_closed_pipe(file: int) -> bool:
    """Whether an open file is a pipe that nobody reads any more; False on Windows, which cannot tell.

    Args:
        file: File descriptor of the end that is written to.
    """
    if not hasattr(select, "poll"):
        return False
    asked = select.poll()
    asked.register(file, select.POLLOUT)
    return any(event & select.POLLERR for _, event in asked.poll(0))
