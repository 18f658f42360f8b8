"""Which cells run again: failed ones once, those of a lost node a few times. Knows nothing of Ray."""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol, runtime_checkable

from .worker import Job

MAX_FAILURES = 2
"""A cell is given up when it has failed this often."""

MAX_LOSSES = 5
"""A cell is given up when this many nodes were lost under it: it may be what ends them."""

POLL_SECONDS = 0.5


class Result(NamedTuple):
    """How an attempt at a cell ended.

    Attributes:
        name: Name of the cell.
        error: Why it failed, in one line; None on success.
        is_lost: Whether its node was lost, so that the error says nothing about the cell.
    """

    name: str
    error: str | None
    is_lost: bool = False


class ClusterGoneError(ConnectionError):
    """The cluster cannot be reached any more."""


@runtime_checkable
class Pool(Protocol):
    """Runs jobs, as many at a time as there is room for.

    Attributes:
        device: Device of the trainings.
    """

    device: str

    def submit(self, job: Job) -> None:
        """Queues a job."""
        ...

    def wait(self, seconds: float) -> list[Result]:
        """The jobs that have ended since the last call; waits up to some seconds for the first.

        Raises:
            ClusterGoneError: If the cluster cannot be reached any more.
        """
        ...

    def stop(self) -> None:
        """Drops what is queued, and interrupts what runs and waits until it has saved a checkpoint."""
        ...


class Event(NamedTuple):
    """What the user is told about a cell.

    Attributes:
        name: Name of the cell.
        state: "finished", "retried", "lost" (and queued again) or "failed" (and given up).
        error: Reason in one line; None if finished.
    """

    name: str
    state: str
    error: str | None


def run_jobs(pool: Pool, jobs: Iterable[Job], on_event: Callable[[Event], None], on_poll: Callable[[], None]) -> None:
    """Runs jobs until each has finished or was given up.

    ``on_event`` is called when an attempt at a cell has ended, ``on_poll`` about twice a second.

    Raises:
        KeyboardInterrupt: After Ctrl-C or SIGTERM; by then the pool has stopped, and unfinished cells can be continued.
        ClusterGoneError: If the cluster cannot be reached any more.
    """
    waiting = {job.name: job for job in jobs}
    failures: Counter[str] = Counter()
    losses: Counter[str] = Counter()
    try:
        for job in waiting.values():
            pool.submit(job)
        while waiting:
            for result in pool.wait(POLL_SECONDS):
                event = _judge(result, failures, losses)
                if event.state in ("finished", "failed"):
                    del waiting[result.name]
                else:
                    pool.submit(waiting[result.name])
                on_event(event)
            on_poll()
    except KeyboardInterrupt:
        pool.stop()
        raise


def _judge(result: Result, failures: Counter[str], losses: Counter[str]) -> Event:
    if result.error is None:
        return Event(result.name, "finished", None)
    counts, limit, again = (losses, MAX_LOSSES, "lost") if result.is_lost else (failures, MAX_FAILURES, "retried")
    counts[result.name] += 1
    return Event(result.name, "failed" if counts[result.name] >= limit else again, result.error)
