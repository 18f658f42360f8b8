"""Nothing outside of one module is of one operating system or of a newer Python than the oldest."""

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from warpgs import posix


def findings(code: str, path: str) -> str:
    """What the linter finds in a file of the package, as JSON."""
    command = [sys.executable, "-m", "ruff", "check", "--output-format", "json", "--stdin-filename", path, "-"]
    return subprocess.run(command, input=code, capture_output=True, text=True).stdout


@pytest.mark.parametrize(
    "code",
    [
        "import fcntl\n",
        "import os\n\nos.fork()\n",
        "from os import nice\n\nnice(1)\n",
        "import signal\n\nsignal.alarm(1)\n",
        "import resource\n",
    ],
)
def test_the_linter_refuses_calls_of_some_systems_outside_of_one_module(code):
    assert "TID251" in findings(code, "warpgs/runs/new.py")
    assert "TID251" not in findings(code, "warpgs/posix.py")


@pytest.mark.parametrize(
    "code", ["type X = int\n", "def f[T](x: T) -> T:\n    return x\n", "try:\n    pass\nexcept* OSError:\n    pass\n"]
)
def test_the_linter_refuses_syntax_that_python_3_10_does_not_have(code):
    assert "Python 3.10" in findings(code, "warpgs/runs/new.py")


@pytest.mark.parametrize(("call", "arguments"), [("open", '"a"'), ("open", '"a", "a"'), ('Path("a").read_text', "")])
def test_the_linter_refuses_text_in_the_encoding_of_the_system(call, arguments):
    assert "PLW1514" in findings(f"from pathlib import Path\n\n{call}({arguments})\n", "warpgs/runs/new.py")
    with_encoding = f"from pathlib import Path\n\n{call}({arguments}, encoding='utf-8')\n".replace("(, ", "(")
    assert "PLW1514" not in findings(with_encoding, "warpgs/runs/new.py")


def test_what_a_system_does_not_have_is_not_done(monkeypatch):
    monkeypatch.delattr(os, "nice")
    monkeypatch.delattr(signal, "pthread_sigmask")
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(posix.ctypes, "CDLL")
    monkeypatch.delattr(posix.select, "poll")
    posix.lower_priority(10)
    posix.unblock_interrupts()
    posix.block_termination()
    posix.share_free_memory()
    posix.release_free_memory()
    assert posix.end_with_parent(os.getppid())
    assert not posix.end_with_parent(-1)
    assert not posix.is_closed_pipe(1)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        posix.interrupt(child)
    assert child.returncode == -signal.SIGTERM


def test_free_memory_is_shared_and_returned_only_by_the_c_library_that_can(monkeypatch):
    calls = []
    glibc = SimpleNamespace(malloc_trim=calls.append, mallopt=lambda *option: calls.append(option))
    monkeypatch.setattr(sys, "platform", "linux")
    for library in (glibc, SimpleNamespace()):  # the second is musl
        monkeypatch.setattr(posix.ctypes, "CDLL", lambda name, library=library: library)
        posix.share_free_memory()
        posix.release_free_memory()
    assert calls == [(posix.M_ARENA_MAX, 1), 0]


def test_a_pipe_is_closed_when_its_reader_is():
    reader, writer = os.pipe()
    assert not posix.is_closed_pipe(writer)
    os.close(reader)
    assert posix.is_closed_pipe(writer)
    os.close(writer)
