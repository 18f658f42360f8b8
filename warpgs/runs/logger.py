"""Progress of a training run: a bar or plain lines on the console, and TensorBoard events."""

import re
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from torch.utils.tensorboard import summary

from warpgs.command_line.screen import fitted

from .events import Events
from .progress import Status

NUM_RECENT = 20
"""Number of reports whose mean speed gives the remaining time: some include pruning or a checkpoint."""

MAX_SLOWNESS = 5.0
"""How much slower than the median a report counts: some include the compilation of kernels."""

LINE_EVERY = 10.0
"""Minimum time between lines if the output is not a terminal, which shows a bar instead [s]."""

WIDE = 126
"""Minimum width of a terminal that shows the bar and all numbers; others show the most important ones in full."""

LINE = re.compile(r"(\d+)/(\d+) .* it/s(?:  (.+) left)?")
"""A line of progress: iterations done, iterations of the whole run, and the remaining time (h:mm:ss) if it is known."""

UNKNOWN = "-:--:--"
"""Stands in the bar where the remaining time is not known yet."""


def ignore(text: str) -> None:
    """A log that discards its lines."""


class TrainingLogger:
    """A context that shows progress and writes TensorBoard events, unless ``folder`` is None.

    Args:
        folder: Folder of the events.
        num_iterations: Iterations of the whole run.
        first_iteration: Iterations that are done when it begins.
        quiet: Whether to print nothing.
        remaining_cost: How much is left to do after an iteration, in any unit; the number of iterations if None.
    """

    _first: int
    _last: tuple[int, float]

    def __init__(
        self,
        folder: Path | None,
        num_iterations: int,
        first_iteration: int,
        quiet: bool = False,
        remaining_cost: Callable[[int], float] | None = None,
    ) -> None:
        self._console = Console(quiet=quiet)
        self._events = None if folder is None else Events(folder, first_iteration)
        self._is_lost = False
        self._total = num_iterations
        self._remaining_cost = remaining_cost or (lambda iteration: num_iterations - iteration)
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self.begin(first_iteration)
        self._last_line = 0.0
        if sys.stdout.isatty() and not quiet:
            self._bar = Progress(
                TextColumn("{task.description}"),
                *([BarColumn()] if self._is_wide else []),
                MofNCompleteColumn(),
                TextColumn("{task.fields[status]}"),
                TextColumn("[progress.remaining]{task.fields[left]}"),
                console=self._console,
            )
            self._task = self._bar.add_task(
                "starting", total=num_iterations, completed=first_iteration, status="", left=UNKNOWN
            )

    def __enter__(self) -> "TrainingLogger":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        if self._events is not None:
            self._events.close()

    @property
    def _is_wide(self) -> bool:
        """Whether a line of the terminal holds a bar and all numbers."""
        return self._console.width >= WIDE

    def log(self, text: str) -> None:
        """Prints a line above the bar."""
        self._console.print(fitted(text, sys.stdout), highlight=False, markup=False, soft_wrap=True)

    def report(self, status: Status) -> None:
        """Shows the status and adds it to the events."""
        last_iteration, last_time = self._last
        now = time.monotonic()
        done, seconds = status.iteration - last_iteration, max(now - last_time, 1e-9)
        rate, self._last = done / seconds, (status.iteration, now)
        if last_iteration > self._first:  # the first interval includes the compilation of kernels
            cost = self._remaining_cost(last_iteration) - self._remaining_cost(status.iteration)
            self._recent.append((max(cost, 1e-9), seconds))
        left = self._time_left(status.iteration)
        text = (
            f"loss {status.loss:.4f}  train PSNR {status.psnr:.2f}  "
            f"static {status.num_static:,}  dynamic {status.num_dynamic:,}  {rate:.1f} it/s"
        )
        if self._bar is not None and self._task is not None:
            num = status.num_static + status.num_dynamic
            narrow = f"train PSNR {status.psnr:.2f}  {num:,} Gaussians  {rate:.0f} it/s"
            shown = text if self._is_wide else narrow
            self._bar.update(
                self._task, completed=status.iteration, description=status.stage, status=shown, left=left or UNKNOWN
            )
        elif now - self._last_line > LINE_EVERY or status.iteration == self._total:
            self._last_line = now
            remaining = f"  {left} left" if left else ""
            self.log(f"{status.iteration}/{self._total} {status.stage}  {text}{remaining}")
        self._write(status, rate)

    def _time_left(self, iteration: int) -> str:
        """The remaining time after an iteration, from the recent speed; empty if that is not known yet."""
        if not self._recent:
            return ""
        limit = MAX_SLOWNESS * statistics.median_low(seconds / cost for cost, seconds in self._recent)
        seconds = sum(min(seconds, limit * cost) for cost, seconds in self._recent)
        left = self._remaining_cost(iteration) * seconds / sum(cost for cost, _ in self._recent)
        return str(timedelta(seconds=round(left)))

    def add_scalar(self, name: str, value: float, iteration: int) -> None:
        """Adds a number to the events."""
        if self._events is not None:
            self._events.add(iteration, summary=summary.scalar(name, value))

    def add_image(self, name: str, image: UInt8[np.ndarray, "H W 3"], iteration: int) -> None:
        """Adds an 8-bit RGB image to the events."""
        if self._events is not None:
            self._events.add(iteration, summary=summary.image(name, image, dataformats="HWC"))
            self._events.flush()

    def begin(self, iteration: int) -> None:
        """Measures the speed from this iteration on, as when a training begins or returns to a checkpoint."""
        self._first = iteration
        self._last = (iteration, time.monotonic())
        self._recent: deque[tuple[float, float]] = deque(maxlen=NUM_RECENT)

    def skip(self, seconds: float) -> None:
        """Leaves out time in which nothing was trained [s]."""
        iteration, at = self._last
        self._last = (iteration, at + seconds)

    @contextmanager
    def fitting(self, name: str) -> Iterator[Callable[[float], None]]:
        """Shows the progress of a fit between two iterations, whose time does not count in their speed.

        Yields a function that takes the fraction of the fit that is done. Nothing is shown before its first call,
        because there may be nothing to fit.
        """
        start = self._last_line = time.monotonic()
        task: TaskID | None = None

        def show(done: float) -> None:
            nonlocal task
            now = time.monotonic()
            left = timedelta(seconds=round((now - start) * (1.0 - done) / done))
            if self._bar is not None and self._task is not None:
                if task is None:
                    self._bar.update(self._task, visible=False)
                    task = self._bar.add_task(name, total=100, status="%", left=UNKNOWN)
                self._bar.update(task, completed=round(100 * done), left=str(left))
            elif now - self._last_line > LINE_EVERY:
                self._last_line = now
                self.log(f"{name}: {done:.0%}  {left} left")

        try:
            yield show
        finally:
            if self._bar is not None and self._task is not None and task is not None:
                self._bar.remove_task(task)
                self._bar.update(self._task, visible=True)
            self.skip(time.monotonic() - start)

    def _write(self, status: Status, rate: float) -> None:
        values = {
            "loss/total": status.loss,
            "psnr/train": status.psnr,
            "gaussians/static": status.num_static,
            "gaussians/dynamic": status.num_dynamic,
            "speed/iterations per second": rate,
            **{f"loss/{name}": value for name, value in status.terms.items()},
        }
        for name, value in values.items():
            self.add_scalar(name, float(value), status.iteration)
        if self._events is None:
            return
        self._events.flush()
        path = self._events.path
        if not self._is_lost and not path.exists() and path.parent.parent.is_dir():  # else the run is gone
            self._is_lost = True
            self.log(f"warning: {path} was deleted: TensorBoard shows nothing of this training")
