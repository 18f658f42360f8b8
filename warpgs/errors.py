"""Errors of commands: one line on stderr and an exit code."""

import atexit
import contextlib
import difflib
import functools
import io
import os
import re
import reprlib
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import ParamSpec

from . import posix
from .command_line.screen import show_error

P = ParamSpec("P")

FAILED = 2
"""Exit code after wrong options or input, or without enough memory."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""

CLOSED = 141
"""Exit code if nobody reads the output any more (``| head``), as in shells."""

ADVICE = "free some, or use smaller images or fewer Gaussians; --device cpu if a GPU has too little"
"""What to do without enough memory, where a command has no advice of its own."""

MAX_GIVEN = 200
"""Maximum number of characters of something unknown to which what is known is compared."""

MAX_MESSAGE = 4000
"""Maximum number of characters of a message: names and values in it come from files."""

OUT_OF_MEMORY = re.compile(
    r"CUDA error: (out of memory|CUBLAS_STATUS_ALLOC_FAILED)"  # torch, outside of its allocator: graphs, pinned memory
    r"|can't allocate memory|not enough memory: you tried to allocate"  # torch on the CPU; the second on Windows
    r"|Failed to allocate \d+ bytes on device '[^']*'$"  # Warp; it says more if a capture forbids the allocation
    r"|\(-4:Insufficient memory\)"  # OpenCV
)
"""Messages of errors that mean lack of memory, but whose types do not say so."""

_prog: ContextVar[str] = ContextVar("prog", default="warpgs")
"""What the user started, as they typed it: ``warpgs``, ``warpgs render``, ``train.py``."""


def say(message: str) -> None:
    """Writes a line on stderr that begins with the program and its command; a terminal may show it as several."""
    show_error(f"{_prog.get()}: {message}")


def run_command(command: Callable[[], object], prog: str = "warpgs", advice: str = ADVICE) -> int:
    """Runs a command and returns its exit code: the int that it returns, 0 if it returns something else.

    ValueError, ImportError, OSError, lack of memory and Ctrl-C end with one line on stderr; for Ctrl-C that is the
    message of the KeyboardInterrupt, if any. Other errors are bugs and are raised.

    Args:
        command: The command.
        prog: The program and its command, ``warpgs render``: what this line and later ones of the program begin with.
        advice: What to do without enough memory.
    """
    _prog.set(prog)
    try:
        code = command()
    except (ValueError, ImportError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _is_output_closed():
            raise  # to ``program``
        say(one_line(error))
        return FAILED
    except KeyboardInterrupt as stop:
        say(str(stop) or "stopped")
        return INTERRUPTED
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        say(f"out of memory ({one_line(error)[:200]}); {advice}")
        return FAILED
    return code if type(code) is int else 0


def _is_output_closed() -> bool:
    """Whether nobody reads standard output any more.

    What could not be written may still be in its buffer, so that flushing fails again, or may be lost; then the pipe is
    asked.
    """
    try:
        sys.stdout.flush()
        return posix.is_closed_pipe(sys.stdout.fileno())
    except BrokenPipeError:
        return True
    except OSError:  # no file, as in notebooks and tests
        return False


@contextlib.contextmanager
def ending_at_once() -> Iterator[None]:
    """While it lasts, Ctrl-C ends the process with one line and ``INTERRUPTED``, and runs nothing else of it.

    For imports: a KeyboardInterrupt in the middle of one is swallowed by some packages, and others turn it into an
    ImportError or a RecursionError. Where Ctrl-C is ignored or handled already, and outside of the main thread, which
    alone handles it, it does nothing.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, f"{_prog.get()}: stopped\n".encode())
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Lets SIGTERM end a command as Ctrl-C does, so that its processes end and the message says how to go on.

    Further ones are ignored, so that they do not interrupt this end: ``timeout`` sends two at once.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def program(main: Callable[P, int]) -> Callable[P, int]:
    """A program's main function.

    It ends with one line after Ctrl-C also while it imports and reads its options, and without one if nobody reads its
    output any more. Characters that standard output cannot represent (outside of terminals on Windows) are escaped, as
    those of standard error are. While Python ends, which takes a second after torch was imported, Ctrl-C is ignored: it
    would end the process without the exit code of the command.
    """

    @functools.wraps(main)
    def run(*args: P.args, **kwargs: P.kwargs) -> int:
        before = _prog.set("warpgs")
        try:
            if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
                sys.stdout.reconfigure(errors="backslashreplace")
            try:
                return main(*args, **kwargs)
            finally:
                sys.stdout.flush()  # at exit, it would be too late to catch the error
        except BrokenPipeError:
            with open(os.devnull, "wb") as nowhere:  # for what Python still writes at exit
                os.dup2(nowhere.fileno(), sys.stdout.fileno())
            return CLOSED
        except KeyboardInterrupt:
            say("stopped")
            return INTERRUPTED
        finally:
            _prog.reset(before)
            atexit.unregister(_ignore_interrupts)
            atexit.register(_ignore_interrupts)  # the last that is registered is the first that is called

    return run


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks and control characters; of a very long one its ends."""
    text = visible(" ".join(str(error).split()))
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE // 2]} … {text[-MAX_MESSAGE // 2 :]}"


def command(*words: object) -> str:
    """A command of this package in a message, quoted so that it can be pasted into a shell."""
    return shlex.join(["warpgs", *map(str, words)])


def suggestion(given: str, known: Iterable[str], shown: Callable[[str], object] = str) -> str:
    """The end of a message about something unknown, "; did you mean X?"; empty if nothing that is known is similar.

    Args:
        given: What is unknown.
        known: What may be meant.
        shown: How the message writes what may be meant.
    """
    given = given[:MAX_GIVEN]
    by_lower_case = {name.lower(): name for name in known}
    close = difflib.get_close_matches(given.lower(), by_lower_case, max(1, len(by_lower_case)))
    if not close:
        return ""
    # Of frame numbers with a digit too few many are as similar: the first of them is meant rather than the last.
    matcher = difflib.SequenceMatcher(None, "", given.lower())

    def similarity(name: str) -> float:
        matcher.set_seq1(name)
        return matcher.ratio()

    best = similarity(close[0])
    first = min(name for name in close if similarity(name) == best)
    return f"; did you mean {shown(by_lower_case[first])}?"


def counted(number: int, noun: str) -> str:
    """A number of things in words: 1 image, 1,200 images."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def not_one_of(name: str, given: object, known: Iterable[str]) -> str:
    """Message that the value of an option is not one of those that are known, and the similar one."""
    known = list(known)
    return f"{name} must be one of {', '.join(known)}, got {reprlib.repr(given)}{suggestion(str(given), known)}"


def similar_path(path: Path) -> str:
    """The suggestion of a path that exists and differs from a missing one in the first part that does not exist."""
    wrong = next((part for part in (path, *path.parents) if os.path.exists(part.parent)), path)
    rest = path.relative_to(wrong)
    try:
        names = [name for name in os.listdir(wrong.parent) if os.path.exists(wrong.parent / name / rest)]
    except OSError:  # no folder, or one that cannot be read
        names = []
    return suggestion(wrong.name, names, lambda name: wrong.parent / name / rest)


def missing(path: Path) -> str:
    """Message that a path does not exist, and a similar one that does."""
    return f"{path} does not exist{similar_path(path)}"


def require_present(*paths: Path) -> None:
    """Raises ValueError if a path does not exist; the message names a similar one that does."""
    for path in paths:
        if not path.exists():
            raise ValueError(missing(path))


def visible(text: str) -> str:
    """A text in which what a terminal would obey is escaped: names of files and fields come from others."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means lack of memory."""
    # torch.OutOfMemoryError by name, because torch takes a second to import.
    has_type = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    return has_type or OUT_OF_MEMORY.search(str(error)) is not None
