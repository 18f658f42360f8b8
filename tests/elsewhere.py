"""A system without what only POSIX has: its modules, functions, signals and flags are missing for modules of warpgs.

Files are as on Windows: one that is open or mapped is not replaced or removed, a folder is not opened or replaced, and
links and names that Windows does not allow are refused. Apart from that, libraries see the system as it is: those
installed here are their versions for it.
"""

import builtins
import os
import re
import signal
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGE = "warpgs"

MISSING_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}

SIGNALS = {"SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM", "SIG_DFL", "SIG_IGN"}
"""Signals and handlers of Windows."""

MISSING: dict[ModuleType, set[str]] = {
    os: {
        *("chown", "chroot", "ctermid", "fchmod", "fchown", "fork", "forkpty", "getegid", "geteuid", "getgid"),
        *("getgroups", "getloadavg", "getpgid", "getpgrp", "getpriority", "getsid", "getuid", "killpg", "lchown"),
        *("mkfifo", "mknod", "nice", "openpty", "posix_fadvise", "posix_fallocate", "posix_spawn", "pread", "pwrite"),
        *("register_at_fork", "sched_getaffinity", "sched_setaffinity", "setpgid", "setsid", "setuid", "statvfs"),
        *("sync", "sysconf", "ttyname", "uname", "wait", "wait3", "wait4", "waitid", "WNOHANG"),
        *(name for name in dir(os) if name.startswith("O_")),
    }
    - {"O_APPEND", "O_CREAT", "O_EXCL", "O_RDONLY", "O_RDWR", "O_TRUNC", "O_WRONLY"},
    signal: {
        *("alarm", "pause", "pthread_kill", "pthread_sigmask", "setitimer", "siginterrupt", "sigwait", "sigtimedwait"),
        *(name for name in dir(signal) if name.startswith("SIG") and name not in SIGNALS),
    },
    sys: set(),
}
"""Names that modules do not have on Windows."""

DIFFERENT = {os: {"name": "nt"}, sys: {"platform": "win32"}, signal: {}}


class Seen(ModuleType):
    """A module as it is elsewhere."""

    def __init__(self, module: ModuleType) -> None:
        super().__init__(module.__name__)
        self.__dict__.update(DIFFERENT[module])
        self._module = module

    def __getattr__(self, name: str) -> Any:
        if name in MISSING[self._module]:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return getattr(self._module, name)


FORBIDDEN = re.compile(r'[<>:"|?*\x00-\x1f\\]|[ .]$|^(con|prn|aux|nul|com[1-9]|lpt[1-9])(\.|$)', re.IGNORECASE)
"""What no name of a file on Windows contains, ends with or is."""

OTHER_FILES = ("/dev/", "/proc/", "/sys/")
"""Files that other systems do not have, or not there; libraries for POSIX use them."""


EVENTS = {"open", "os.mkdir", "os.remove", "os.rename", "os.symlink"}
"""Operations on files that are looked at."""


def in_use(path: Path) -> bool:
    """Whether this process has a file, or one in the folder, open or mapped."""
    used = [line.split(maxsplit=5)[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "/" in line]
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            used.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        except FileNotFoundError:  # that of the list itself
            continue
    return any(path == Path(name) or path in Path(name).parents for name in used)


def absolute(path: Any, folder: int) -> Path:
    """A path of an event; relative to an open folder if there is one."""
    base = os.readlink(f"/proc/self/fd/{folder}") if folder >= 0 else os.getcwd()
    return Path(os.path.normpath(os.path.join(base, os.fsdecode(path))))


def refuse(event: str, args: tuple[Any, ...]) -> None:
    """An audit hook: an error where Windows refuses an operation on files.

    Raises:
        PermissionError: If a file is in use, or a folder is opened, or for links.
        OSError: If a name is not allowed.
    """
    if event not in EVENTS:
        return
    importer = sys._getframe(1).f_globals.get("__name__", "")
    if event == "os.symlink":
        raise PermissionError(1314, "a required privilege is not held by the client", args[1])
    if event in ("os.rename", "os.remove") and importer != "tempfile":
        paths = [absolute(args[0], args[-1] if event == "os.remove" else args[2])]
        if event == "os.rename":
            paths.append(absolute(args[1], args[3]))
        if used := next((path for path in paths if in_use(path) or (path != paths[0] and path.is_dir())), None):
            raise PermissionError(13, "used by another process, or a folder that exists", str(used))
    if event == "open" and isinstance(args[0], str) and not args[0].startswith(OTHER_FILES):
        if importer.partition(".")[0] == PACKAGE and os.path.isdir(args[0]):
            raise PermissionError(13, "a folder cannot be opened", args[0])
        if (args[2] or 0) & os.O_CREAT:
            check_name(args[0])
    if event == "os.mkdir":
        check_name(args[0])


def check_name(path: Any) -> None:
    """Raises an OSError if the last part of a path is not a name on Windows."""
    if FORBIDDEN.search(os.path.basename(os.fsdecode(path).rstrip("/"))):
        raise OSError(22, "the name is invalid", os.fsdecode(path))


def install() -> None:
    """From now on, modules of warpgs that are imported see another system, and all files are as there."""
    sys.addaudithook(refuse)  # which stays until the process ends
    hide()


def hide() -> None:
    """From now on, modules of warpgs that are imported see another system."""
    seen, original = {module.__name__: Seen(module) for module in MISSING}, builtins.__import__

    def import_elsewhere(name: str, *args: Any, **kwargs: Any) -> ModuleType:
        importer = kwargs.get("globals", args[0] if args else None) or {}
        level = kwargs.get("level", args[3] if len(args) > 3 else 0)
        if level or str(importer.get("__name__")).partition(".")[0] != PACKAGE:
            return original(name, *args, **kwargs)
        if name in MISSING_MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return seen.get(name) or original(name, *args, **kwargs)

    builtins.__import__ = import_elsewhere
