"""A system without what only POSIX has: its modules, functions, signals and flags are missing for modules of warpgs.

Libraries see the system as it is: those installed here are their versions for it.
"""

import builtins
import os
import signal
import sys
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


def install() -> None:
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
