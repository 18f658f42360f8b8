"""Trainings that share a GPU run on it at the same time: NVIDIA's Multi-Process Service (MPS)."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager

CONTROL = "nvidia-cuda-mps-control"
"""Program of the driver that starts and ends MPS, which needs no privileges."""

PIPES = "CUDA_MPS_PIPE_DIRECTORY"
"""Variable by which CUDA finds MPS: the folder of its sockets."""

QUERY = b"get_server_list\n"
"""Asks for the servers of MPS, of which there are none before the first process."""

NOT_RUNNING = b"Cannot find MPS control daemon"
"""Answer where MPS does not run."""

QUIT = b"quit -t 5\n"
"""Ends MPS, at the latest after 5 s, even if a process still uses it."""

TIMEOUT = 30.0
"""Time for MPS to start or to end [s]."""


@contextmanager
def shared_gpus(log: Callable[[str], None]) -> Iterator[None]:
    """Processes that start in this context share GPUs through MPS.

    Without it, CUDA runs the kernels of one process at a time, however few of the multiprocessors they use. An MPS that
    the environment names (CUDA_MPS_PIPE_DIRECTORY), or that runs in its default folder, is used as it is.

    Args:
        log: Receives a line if MPS cannot be started, so that processes take turns, or cannot be ended.
    """
    if PIPES in os.environ or _runs():
        yield
        return
    with tempfile.TemporaryDirectory(prefix="warpgs-mps-", ignore_cleanup_errors=True) as folder:
        # A GPU hidden from MPS would change the numbers by which its clients name the others.
        environment = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}
        problem = _start({**environment, PIPES: folder, "CUDA_MPS_LOG_DIRECTORY": folder})
        if problem:
            log(f"trainings take turns on a GPU, because {problem}")
            yield
            return
        os.environ[PIPES] = folder
        try:
            yield
        finally:
            try:
                subprocess.run([CONTROL], input=QUIT, capture_output=True, timeout=TIMEOUT, check=True)
            except (OSError, subprocess.SubprocessError) as error:
                log(f"{CONTROL} did not end: {error}")
            del os.environ[PIPES]


def _runs() -> bool:
    """Whether MPS answers in its default folder, where processes without the variable look for it."""
    try:
        done = subprocess.run([CONTROL], input=QUERY, capture_output=True, timeout=TIMEOUT)
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0 and NOT_RUNNING not in done.stdout + done.stderr


def _start(environment: dict[str, str]) -> str:
    """Starts MPS; returns what went wrong, or nothing."""
    if shutil.which(CONTROL) is None:
        return f"{CONTROL} is not installed"
    try:
        done = subprocess.run([CONTROL, "-d"], env=environment, stdin=subprocess.DEVNULL, timeout=TIMEOUT)
    except (OSError, subprocess.SubprocessError) as error:
        return f"{CONTROL} did not start: {error}"
    return f"{CONTROL} ended with exit code {done.returncode}" if done.returncode else ""
