"""Which cells run again."""

import pytest

from warpgs.sweep.scheduler import MAX_LOSSES, ClusterGoneError, Event, Result, run_jobs
from warpgs.sweep.worker import Job


class Script:
    """A pool in which the attempts at each job end as told; None is success, "lost" a lost node."""

    device = "cpu"

    def __init__(self, ends):
        self.ends, self.queue, self.stopped = {name: list(e) for name, e in ends.items()}, [], False

    def submit(self, job):
        self.queue.append(job.name)

    def wait(self, seconds):
        name = self.queue.pop(0)
        end = self.ends[name].pop(0)
        if isinstance(end, BaseException):
            raise end
        return [Result(name, end, end == "lost")]

    def stop(self):
        self.stopped = True


def run(ends):
    pool, events, jobs = Script(ends), [], [Job(name, "", "", "", (), "cpu") for name in ends]
    run_jobs(pool, jobs, events.append, lambda: None)
    return pool, events


def test_a_failed_cell_is_retried_once_and_stops_no_other():
    pool, events = run({"a": ["bad", "worse"], "b": [None], "c": ["bad", None]})
    assert events == [
        Event("a", "retried", "bad"),
        Event("b", "finished", None),
        Event("c", "retried", "bad"),
        Event("a", "failed", "worse"),
        Event("c", "finished", None),
    ]
    assert not any(pool.ends.values())


def test_a_lost_node_is_not_a_failure_of_the_cell():
    _, events = run({"a": ["lost", "lost", "bad", "lost", None]})
    assert [event.state for event in events] == ["lost", "lost", "retried", "lost", "finished"]


def test_a_cell_under_which_every_node_is_lost_is_given_up():
    pool, events = run({"a": ["lost"] * (MAX_LOSSES + 1)})
    assert [event.state for event in events] == ["lost"] * (MAX_LOSSES - 1) + ["failed"]
    assert len(pool.ends["a"]) == 1


def stopped_by(pool, error):
    """Whether a pool of one job is stopped, in which an error ends the sweep."""
    with pytest.raises(error):
        run_jobs(pool, [Job("a", "", "", "", (), "cpu")], lambda event: None, lambda: None)
    return pool.stopped


def test_ctrl_c_stops_the_pool():
    assert stopped_by(Script({"a": [KeyboardInterrupt()]}), KeyboardInterrupt)


def test_ctrl_c_while_jobs_are_queued_stops_the_pool():
    class Queueing(Script):
        def submit(self, job):
            raise KeyboardInterrupt

    assert stopped_by(Queueing({}), KeyboardInterrupt)


def test_a_cluster_that_is_gone_is_not_asked_to_stop():
    assert not stopped_by(Script({"a": [ClusterGoneError("gone")]}), ClusterGoneError)
