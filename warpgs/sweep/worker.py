"""Runs one cell in a child process; the part of a sweep that happens on the nodes of a cluster."""

import os
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from warpgs.errors import one_line
from warpgs.files import write_text
from warpgs.posix import allow_interrupts, interrupt

POLL_SECONDS = 0.2
GRACE_SECONDS = 120.0
"""Time that a cell has to finish its iteration and save a checkpoint when the sweep is stopped [s]."""

MAX_REASON = 300
"""Maximum number of characters of the reason of a failure."""

LAST_BYTES = 1 << 14
"""Bytes at the end of a log in which the reason of a failure and the progress are looked for."""

STARTED = "warpgs "
"""Start of the first line that each attempt at a cell writes into its log, after the name of the host."""


class Job(NamedTuple):
    """What a node needs to know about a cell; only plain values, which are sent over the network.

    Attributes:
        name: Name of the cell.
        folder: Run folder.
        log: File that its output is appended to.
        running: File that exists while it runs, and holds the name of the host.
        arguments: Arguments of ``warpgs train`` for a new run.
        device: Device to train on.
        evaluation: Options of the evaluation, for a run that has begun.
        is_trained: Whether there is nothing to do but to evaluate it.
    """

    name: str
    folder: str
    log: str
    running: str
    arguments: tuple[str, ...]
    device: str
    evaluation: tuple[str, ...] = ()
    is_trained: bool = False


def run_job(job: Job) -> str | None:
    """Trains and evaluates a cell, from its newest checkpoint if there is one; one that is trained is evaluated.

    Returns:
        None on success, else one line that names the host and says why it failed.

    Raises:
        KeyboardInterrupt: If it was stopped; a checkpoint was saved.
    """
    running = Path(job.running)
    allow_interrupts()  # which are ignored if the sweep, or its node, was started with &
    try:
        write_text(running, socket.gethostname())
        reason = _train(job)
    except OSError as error:  # a full disk, or a file system that is not mounted on this node
        reason = one_line(error)
    finally:
        with suppress(OSError):
            running.unlink(missing_ok=True)
    return None if reason is None else f"{socket.gethostname()}: {reason}"


def _train(job: Job) -> str | None:
    if job.is_trained:
        arguments = ["eval", job.folder, *job.evaluation]
    elif (Path(job.folder) / "config.json").is_file():
        arguments = ["train", "--resume", job.folder, *job.evaluation]
    else:
        arguments = ["train", *job.arguments]
    arguments += ["--device", job.device]
    log_path = Path(job.log)
    _append(log_path, f"{STARTED}{' '.join(arguments)}")
    with open(log_path, "ab") as log:
        command = [sys.executable, "-m", "warpgs.sweep.child", str(os.getpid()), *arguments]
        # A session of its own: Ctrl-C in the terminal reaches the sweep, which stops its cells itself.
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
        code = _wait(child)
    if code == 0:
        return None
    if code < 0:
        return f"the training was killed by signal {-code}"
    lines = last_lines(log_path)
    reason = lines[-1][:MAX_REASON] if lines else f"it wrote nothing into {log_path}"
    _append(log_path, f"ended with exit code {code}")  # fails if the disk was too full for the reason
    return reason


def _append(log: Path, line: str) -> None:
    """Appends a line to a log, after the name of the host.

    Raises:
        OSError: If it cannot be written; the message names the log.
    """
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "a", encoding="utf-8") as file:
            file.write(f"{socket.gethostname()}: {line}\n")
    except OSError as error:
        raise OSError(f"{log} could not be written: {error.strerror}") from error


def _wait(child: subprocess.Popen[bytes]) -> int:
    """The exit code; an interrupt is passed on, once, and waited for."""
    try:
        while True:
            with suppress(subprocess.TimeoutExpired):  # in steps, so that Ray can interrupt this thread
                return child.wait(POLL_SECONDS)
    finally:
        if child.poll() is None:
            interrupt(child)
            try:
                child.wait(GRACE_SECONDS)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def last_lines(log: Path) -> list[str]:
    """The last lines of a log that are not empty; in the last one, commands and exceptions say what went wrong."""
    with open(log, "rb") as file:
        file.seek(max(0, log.stat().st_size - LAST_BYTES))
        lines = file.read().decode(errors="replace").splitlines()
    return [line.strip() for line in lines if line.strip()]
