"""Which cells run again, and where: failed ones once, those of a lost node a few times. Knows nothing of Ray."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Set
from typing import NamedTuple, Protocol, runtime_checkable

from .nodes import Nodes
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
        node: Id of the node that it ran on; empty if it is not known, as that of a lost one.
    """

    name: str
    error: str | None
    is_lost: bool = False
    node: str = ""


class ClusterGoneError(ConnectionError):
    """The cluster cannot be reached any more."""


@runtime_checkable
class Pool(Protocol):
    """Runs jobs, as many at a time as there is room for.

    Attributes:
        device: Device of the trainings.
    """

    device: str

    def submit(self, job: Job, avoid: Set[str] = frozenset()) -> None:
        """Queues a job, for any node but those to avoid."""
        ...

    def move(self, job: Job, avoid: Set[str]) -> None:
        """Changes the nodes that a queued job avoids; one that runs goes on where it is."""
        ...

    def nodes(self) -> Set[str]:
        """Ids of the nodes that are alive and have room for a job."""
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


def run_jobs(
    pool: Pool,
    jobs: Iterable[Job],
    on_event: Callable[[Event], None],
    on_poll: Callable[[], None],
    log: Callable[[str], object] = print,
) -> None:
    """Runs jobs until each has finished or was given up.

    ``on_event`` is called when an attempt at a cell has ended, ``on_poll`` about twice a second, ``log`` with a line
    about each node that gets no more cells, or gets them again.

    Raises:
        KeyboardInterrupt: After Ctrl-C or SIGTERM; by then the pool has stopped, and unfinished cells can be continued.
        ClusterGoneError: If the cluster cannot be reached any more.
    """
    waiting = {job.name: job for job in jobs}
    avoided: dict[str, Set[str]] = dict.fromkeys(waiting, frozenset())
    counts: Counter[tuple[str, bool]] = Counter()
    nodes = Nodes()
    try:
        for job in waiting.values():
            pool.submit(job)
        while waiting:
            results = pool.wait(POLL_SECONDS)
            events = [_judge(result, counts) for result in results]
            for result, event in zip(results, events, strict=True):
                nodes.note(result.name, result.node, result.error)
                if event.state in ("finished", "failed"):
                    del waiting[result.name]
            for line in nodes.exclude(pool.nodes()):
                log(line)
            _place(pool, waiting, avoided, nodes, {result.name for result in results})
            for event in events:
                on_event(event)
            on_poll()
    except KeyboardInterrupt:
        pool.stop()
        raise


def _place(pool: Pool, waiting: Mapping[str, Job], avoided: dict[str, Set[str]], nodes: Nodes, ended: Set[str]) -> None:
    """Queues the cells again whose attempts have ended, and moves those that avoid other nodes than before."""
    for name, job in waiting.items():
        avoid = nodes.avoided_by(name)
        if name in ended:
            pool.submit(job, avoid)
        elif avoid != avoided[name]:
            pool.move(job, avoid)
        avoided[name] = avoid


def _judge(result: Result, counts: Counter[tuple[str, bool]]) -> Event:
    if result.error is None:
        return Event(result.name, "finished", None)
    limit, again = (MAX_LOSSES, "lost") if result.is_lost else (MAX_FAILURES, "retried")
    counts[result.name, result.is_lost] += 1
    return Event(result.name, "failed" if counts[result.name, result.is_lost] >= limit else again, result.error)
