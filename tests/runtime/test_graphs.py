"""The cache of CUDA graphs; without a GPU, a replay is simulated by repeating the work."""

import gc
from unittest.mock import MagicMock

import pytest
import torch

from warpgs.runtime import graphs
from warpgs.runtime.graphs import WARM_UPS, GraphCache


@pytest.fixture
def captures(monkeypatch):
    """A list with one entry for each capture."""
    made = []

    def record(work, _stream=None, _pool=None):
        made.append(work)
        return work

    monkeypatch.setattr(graphs, "record", record)
    return made


class Work:
    """Counts its runs in a tensor that stays at the same address."""

    def __init__(self):
        self.count = torch.zeros(1)

    def __call__(self):
        self.count += 1
        return (self.count,)


def run(cache, key, work, times):
    for _ in range(times):
        outputs = cache.run(key, work)
    return outputs


def test_the_first_runs_are_eager(captures):
    cache, work = GraphCache(2, repeatable=False), Work()
    for number in range(1, WARM_UPS + 1):
        (count,) = cache.run("key", work)
        assert count == number
        assert not cache.is_captured("key")
    assert not captures


def test_one_capture_per_key_is_replayed(captures):
    cache, first, second = GraphCache(2, repeatable=False), Work(), Work()
    run(cache, "first", first, WARM_UPS + 3)
    assert len(captures) == 1
    assert cache.is_captured("first")
    assert not cache.is_captured("second")
    run(cache, "second", second, WARM_UPS + 3)
    run(cache, "first", first, 2)
    assert len(captures) == 2
    assert (first.count, second.count) == (WARM_UPS + 5, WARM_UPS + 3)


def test_replays_return_the_same_tensors(monkeypatch):
    def record(work, _stream=None, _pool=None):
        outputs = work()
        return lambda: outputs  # a graph does not run Python

    monkeypatch.setattr(graphs, "record", record)
    cache = GraphCache(1, repeatable=False)
    run(cache, "key", lambda: (torch.ones(2),), WARM_UPS)
    first, second = (cache.run("key", lambda: (torch.ones(2),)) for _ in range(2))
    assert first[0] is second[0]


def test_repeatable_work_is_captured_in_its_first_run(monkeypatch):
    captured = []
    monkeypatch.setattr(graphs, "capture", lambda work: captured.append(work) or work)
    cache, work = GraphCache(1, repeatable=True), Work()
    run(cache, "key", work, 3)
    assert cache.is_captured("key")
    assert len(captured) == 1


def test_a_key_is_captured_again_after_invalidation_without_warm_up(captures):
    cache, work = GraphCache(2, repeatable=False), Work()
    run(cache, "key", work, WARM_UPS + 1)
    cache.invalidate()
    assert not cache.is_captured("key")
    run(cache, "key", work, 2)
    assert len(captures) == 2
    assert cache.is_captured("key")


def test_the_oldest_graph_is_dropped(captures):
    cache, work = GraphCache(2, repeatable=False), Work()
    for key in ("oldest", "middle", "newest"):
        run(cache, key, work, WARM_UPS + 1)
    assert [cache.is_captured(key) for key in ("oldest", "middle", "newest")] == [False, True, True]
    run(cache, "oldest", work, 1)
    assert len(captures) == 4
    assert [cache.is_captured(key) for key in ("oldest", "middle", "newest")] == [True, False, True]


def test_a_capture_that_fails_is_not_kept(captures, monkeypatch):
    def record(_work, _stream, _pool):
        raise RuntimeError("the capture failed")

    cache, work = GraphCache(1, repeatable=False), Work()
    run(cache, "key", work, WARM_UPS)
    with monkeypatch.context() as patched:
        patched.setattr(graphs, "record", record)
        with pytest.raises(RuntimeError, match="the capture failed"):
            cache.run("key", work)
    assert not cache.is_captured("key")
    run(cache, "key", work, 1)
    assert cache.is_captured("key")


@pytest.fixture
def capture_end(monkeypatch):
    """Replaces CUDA; the end of a capture, which fails as that of an invalid one does."""
    cuda = MagicMock()
    cuda.mem_get_info.return_value, cuda.memory_reserved.return_value, cuda.memory_allocated.return_value = (1, 1), 0, 0
    cuda.CUDAGraph.return_value.capture_end.side_effect = RuntimeError("operation failed due to a previous error")
    monkeypatch.setattr(graphs, "torch", MagicMock(cuda=cuda))
    monkeypatch.setattr(graphs, "side_stream", lambda _device: None)
    return cuda.CUDAGraph.return_value.capture_end


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), KeyboardInterrupt("stopped")])
def test_an_error_inside_a_capture_is_not_hidden_by_that_of_its_end(capture_end, error):
    def work():
        raise error

    with pytest.raises(type(error)) as raised:
        graphs.record(work)
    assert raised.value is error
    capture_end.assert_called_once_with()  # or the stream would stay in capture mode


def test_an_error_at_the_end_of_a_capture_is_raised(capture_end):
    with pytest.raises(RuntimeError, match="previous error"):
        graphs.record(lambda: (torch.ones(1),))


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_not_collected_during_a_capture(enabled, monkeypatch):
    """Freeing the memory of another graph makes a capture invalid."""
    seen = []

    class Graph:
        def capture_begin(self, _pool, capture_error_mode):
            seen.append(gc.isenabled())

        def capture_end(self):
            seen.append(gc.isenabled())

    def work():
        seen.append(gc.isenabled())
        raise KeyError

    monkeypatch.setattr(graphs.torch, "cuda", MagicMock(CUDAGraph=Graph, mem_get_info=lambda: (1,)))
    monkeypatch.setattr(graphs.torch.cuda, "memory_reserved", lambda: 0)
    monkeypatch.setattr(graphs.torch.cuda, "memory_allocated", lambda: 0)
    monkeypatch.setattr(graphs, "side_stream", lambda device: None)
    before = gc.isenabled()
    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(KeyError):
            graphs.record(work)
        assert seen == [False, False, False]
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if before else gc.disable)()
