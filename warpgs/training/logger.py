"""What a run says while it trains: a progress bar, or plain lines; TensorBoard events."""

import sys
import time
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard.writer import SummaryWriter

LINE_EVERY = 10.0
"""Seconds between lines where there is no terminal to draw a bar on."""


class Status(NamedTuple):
    """A look at the training, taken now and then.

    Attributes:
        iteration: Iterations done.
        stage: Name of the stage.
        loss: Mean since the last look.
        psnr: Of the joint image against the truth, mean since the last look [dB].
        terms: Each loss term, weighted, mean since the last look.
        num_static, num_dynamic: Gaussians.
    """

    iteration: int
    stage: str
    loss: float
    psnr: float
    terms: dict[str, float]
    num_static: int
    num_dynamic: int


class TrainingLogger:
    """A context that shows progress and writes TensorBoard events into ``folder``."""

    def __init__(self, folder: Path, num_iterations: int, first_iteration: int) -> None:
        self._console = Console()
        self._events = SummaryWriter(str(folder), purge_step=first_iteration)
        self._total = num_iterations
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._first = first_iteration
        self._last = (first_iteration, time.monotonic())
        self._last_line = 0.0
        if sys.stdout.isatty():
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[facts]}"),
                TimeRemainingColumn(),
                console=self._console,
            )
            self._task = self._bar.add_task("starting", total=num_iterations, completed=first_iteration, facts="")

    def __enter__(self) -> "TrainingLogger":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._events.close()

    def say(self, text: str) -> None:
        """One line for the reader, above the bar."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(self, status: Status) -> None:
        before, then = self._last
        now = time.monotonic()
        rate = (status.iteration - before) / max(now - then, 1e-9)
        self._last = (status.iteration, now)
        facts = (
            f"loss {status.loss:.4f}  PSNR {status.psnr:.2f}  "
            f"static {status.num_static:,}  dynamic {status.num_dynamic:,}  {rate:.1f} it/s"
        )
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=status.iteration, description=status.stage, facts=facts)
        elif now - self._last_line > LINE_EVERY or status.iteration == self._total:
            self._last_line = now
            left = ""
            if before > self._first:  # else kernels were compiled until now, which does not go on
                left = f"  {(self._total - status.iteration) / max(rate, 1e-9):.0f} s left"
            self.say(f"{status.iteration}/{self._total} {status.stage}  {facts}{left}")
        self._write(status, rate)

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
            self._events.add_scalar(name, value, status.iteration)
