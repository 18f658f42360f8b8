"""A program on a terminal of its own, whose output is read while it runs."""

import os
import pty
import re
import select
import subprocess
import sys
import time

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")


class Terminal:
    """Runs Python code on a pseudoterminal; a context that ends it.

    Attributes:
        output: What it has written so far, without control characters.
    """

    def __init__(self, code: str, *arguments: str, columns: int = 80, lines: int = 24) -> None:
        self._file, child = pty.openpty()
        environment = {**os.environ, "TERM": "xterm", "COLUMNS": str(columns), "LINES": str(lines)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdin=child,
            stdout=child,
            stderr=child,
            env=environment,
            close_fds=True,
        )
        os.close(child)
        self.output = ""

    def read_until(self, text: str, seconds: float = 60.0) -> str:
        """What is written up to a text, which must follow."""
        end, start = time.monotonic() + seconds, len(self.output)
        while text not in self.output[start:]:
            is_ready, _, _ = select.select([self._file], [], [], max(0.0, end - time.monotonic()))
            try:
                data = os.read(self._file, 1 << 16) if is_ready else b""
            except OSError:  # the program has ended
                data = b""
            assert data, f"no {text!r} in {self.output!r}"
            self.output += CONTROL.sub("", data.decode())
        return self.output[start:]

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._file)
