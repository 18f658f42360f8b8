"""Browsers come, look at images, and leave: the viewer keeps nothing of them."""

import random
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.campaign.browser import SECONDS, Browser
from tests.campaign.memory import MAX_GROWTH, growth, in_mebibytes, needs_proc, resident
from tests.viewer import watched
from warpgs.runs import checkpoint
from warpgs.viewer.layers import LAYERS

PER_VISIT = 20
"""Inputs of the other campaigns per visit, which takes longer."""

PAUSE = 1.0
"""Time from one visit to the next, in visits that are to last some time [s]."""

MIN_VISITS = 100
"""Fewer are too few for memory to settle."""

MAX_THREADS = 32
"""Threads beyond those of before the first visit: viser keeps a pool of as many."""


@pytest.fixture
def run(finished_run, tmp_path):
    return watched.copy(finished_run, tmp_path)


@pytest.fixture
def viewer(run, tmp_path):
    """A viewer in a process of its own, and its port."""
    command = [sys.executable, "-m", "warpgs", "view", str(run), "--port", "0", "--device", "cpu", "--while-training"]
    output = tmp_path / "output.txt"
    with output.open("w") as file, subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT) as process:
        while (found := re.search(r"http://127.0.0.1:(\d+) ", output.read_text())) is None:
            assert process.poll() is None, output.read_text()
            time.sleep(0.05)
        yield process, int(found[1])
        process.terminate()


CONTROLS: dict[str, Callable[[random.Random], object]] = {
    "time": random.Random.random,
    "layer": lambda r: r.choice(list(LAYERS)),
    "appearance": lambda r: r.random() < 0.5,
    "width [px]": lambda r: r.randrange(160, 400, 80),
    "camera": lambda r: r.randrange(1, 4),
    "truth": random.Random.random,
    "show in the scene": lambda _: True,
    "Play": lambda _: True,
    "Screenshot": lambda _: True,
    "Add keyframe": lambda _: True,
    "Save path": lambda _: True,
}
"""What browsers change, and how."""


def visit(k: int, port: int) -> int:
    """Visit k of the campaign; returns the number of images seen."""
    r = random.Random(k)
    with Browser(port, r) as browser:
        for _ in range(r.randrange(5)):  # some are too impatient for an image
            browser.look()
            control = r.choice(list(CONTROLS))
            browser.set(control, CONTROLS[control](r))
            browser.move()
        return browser.images


def held(process: int) -> tuple[int, int]:
    """Numbers of threads and of open files of a process."""
    return len(list(Path(f"/proc/{process}/task").iterdir())), len(list(Path(f"/proc/{process}/fd").iterdir()))


def advance(run: Path) -> None:
    """Lets training have gone on: another checkpoint instead of the newest."""
    before = checkpoint.list_checkpoints(run)[-1]
    watched.advance(run)
    before.unlink()


@needs_proc
def test_the_viewer_keeps_nothing_of_browsers_that_left(run, viewer, count, minutes):
    (process, port), number = viewer, count // PER_VISIT
    idle_threads, idle_files = held(process.pid)
    sizes: list[int] = []
    k = images = 0
    start = time.monotonic()
    while k < number or time.monotonic() < start + 60 * minutes:
        images += visit(k, port)
        k += 1
        if k % 10 == 0:
            advance(run)
        if minutes:
            time.sleep(max(0.0, start + k * PAUSE - time.monotonic()))
        sizes.append(resident(process.pid))
    duration = (time.monotonic() - start) / 60
    sys.stdout.write(f"{k} visits with {images} images in {duration:.1f} minutes\n")
    sys.stdout.write(f"resident memory [MiB]: {in_mebibytes(sizes)}, growth {growth(sizes) / 2**20:.2f}\n")
    end = time.monotonic() + SECONDS
    while held(process.pid)[1] > idle_files and time.monotonic() < end:
        time.sleep(0.05)
    threads, files = held(process.pid)
    assert threads <= idle_threads + MAX_THREADS
    assert files <= idle_files
    assert len(sizes) < MIN_VISITS or growth(sizes) < MAX_GROWTH
    assert process.poll() is None
