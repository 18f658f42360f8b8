"""Which cells run again, and where."""

import itertools

import pytest

from warpgs.sweep.scheduler import MAX_LOSSES, ClusterGoneError, Event, Result, run_jobs
from warpgs.sweep.worker import Job


class Script:
    """A pool in which the attempts at each job end as told; None is success, "lost" a lost node."""

    device = "cpu"

    def __init__(self, ends):
        self.ends, self.queue, self.stopped = {name: list(e) for name, e in ends.items()}, [], False

    def submit(self, job, avoid=frozenset()):
        self.queue.append(job.name)

    def move(self, job, avoid):
        raise AssertionError("a single node has no node to exclude")

    def nodes(self):
        return set()

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
        def submit(self, job, avoid=frozenset()):
            raise KeyboardInterrupt

    assert stopped_by(Queueing({}), KeyboardInterrupt)


def test_a_cluster_that_is_gone_is_not_asked_to_stop():
    assert not stopped_by(Script({"a": [ClusterGoneError("gone")]}), ClusterGoneError)


class Nodes(Script):
    """A pool of nodes; ``end(cell, node)`` says how an attempt ends, and ``turns`` which node is free next."""

    device = "cpu"

    def __init__(self, end, turns):
        self.end, self.turns, self.alive = end, itertools.cycle(turns), set(turns)
        self.queue, self.ran, self.lines = {}, [], []

    def submit(self, job, avoid=frozenset()):
        assert job.name not in self.queue
        self.queue[job.name] = avoid

    def move(self, job, avoid):
        del self.queue[job.name]
        self.queue[job.name] = avoid  # at the end, behind cells that are retried

    def nodes(self):
        return self.alive

    def wait(self, seconds):
        assert all(self.alive - avoid for avoid in self.queue.values()), "a cell waits forever"
        node = next(self.turns)
        name = next((name for name, avoid in self.queue.items() if node not in avoid), None)
        if node not in self.alive or name is None:
            return []
        del self.queue[name]
        self.ran.append((name, node))
        error = self.end(name, node)
        return [Result(name, error, error == "lost", node)]

    def run(self, cells):
        events = []
        jobs = [Job(name, "", "", "", (), "cpu") for name in cells]
        run_jobs(self, jobs, events.append, lambda: None, self.lines.append)
        return {name: [event.state for event in events if event.name == name] for name in cells}

    def on(self, node):
        """The cells that ran on a node."""
        return "".join(name for name, own in self.ran if own == node)


FAILS_FAST = ("bad", "bad", "bad", "good")


def test_a_node_that_fails_every_cell_costs_none_and_soon_gets_none():
    pool = Nodes(lambda name, node: "full" if node == "bad" else None, FAILS_FAST)
    assert all(states[-1] == "finished" for states in pool.run("abcdef").values())
    assert pool.on("bad") == "ab"
    assert pool.lines == ["node bad gets no more cells: a, b failed on it in a row (full)"]


def test_a_failed_cell_is_retried_on_another_node():
    pool = Nodes(lambda name, node: "once" if (name, len(pool.ran)) == ("a", 1) else None, ("one", "one", "two"))
    assert pool.run("abc")["a"] == ["retried", "finished"]
    assert (pool.ran[0], pool.ran.index(("a", "two")) > 0) == (("a", "one"), True)
    assert pool.lines == []


def test_cells_that_fail_on_two_nodes_exclude_none_of_them_from_others():
    pool = Nodes(lambda name, node: "broken" if name in "ab" else None, FAILS_FAST)
    states = pool.run("abcdefgh")
    assert states["a"] == states["b"] == ["retried", "failed"]
    assert all(states[name] == ["finished"] for name in "cdefgh")
    assert pool.lines == [
        "node bad gets no more cells: a, b failed on it in a row (broken)",
        "node bad gets cells again",
    ]
    assert len(pool.on("bad")) > 2


def test_a_node_that_also_finishes_cells_is_not_excluded():
    pool = Nodes(lambda name, node: "unlucky" if node == "one" and name in "ae" else None, ("one", "two"))
    pool.run("abcdefghij")
    assert pool.on("one").startswith("ace")
    assert pool.lines == []


@pytest.mark.parametrize("turns", [("only",), ("one", "two")])
def test_where_every_node_fails_every_cell_is_given_up_after_two_attempts(turns):
    pool = Nodes(lambda name, node: "full", turns)
    assert set(map(tuple, pool.run("abcdef").values())) == {("retried", "failed")}
    assert len(pool.ran) == 12
    assert pool.lines == [] or turns != ("only",)


def test_an_excluded_node_gets_cells_again_once_it_is_the_only_one():
    def end(name, node):
        if node == "good":
            pool.alive.discard("good")
            return "lost"
        return "full" if len(pool.ran) < 3 else None

    pool = Nodes(end, ("bad", "bad", "good"))
    assert all(states[-1] == "finished" for states in pool.run("abcdef").values())
    assert pool.lines[1:] == ["node bad gets cells again"]


def test_a_failure_on_an_unknown_node_excludes_none():
    class Unknown(Nodes):
        def wait(self, seconds):
            return [result._replace(node="") for result in super().wait(seconds)]

    pool = Unknown(lambda name, node: "full", ("one", "two"))
    assert set(map(tuple, pool.run("abc").values())) == {("retried", "failed")}
    assert pool.lines == []
