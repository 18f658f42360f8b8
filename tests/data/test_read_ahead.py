"""Items are read before they are taken, in bounded number, and errors are those of reading."""

import threading
from itertools import count

import pytest

from warpgs.data import read_ahead
from warpgs.data.read_ahead import ReadAhead


class Reader:
    """Notes what is read and by which threads."""

    def __init__(self):
        self.read, self.threads, self.go = [], set(), threading.Event()
        self.go.set()

    def __call__(self, index):
        self.threads.add(threading.get_ident())
        self.go.wait(10.0)
        self.read.append(index)
        if index == 13:
            raise ValueError("frame 13 is damaged")
        return 10 * index


@pytest.fixture
def reader(monkeypatch):
    monkeypatch.setattr(read_ahead.os, "cpu_count", lambda: 3)
    return Reader()


def test_announced_items_are_read_once_by_threads_in_order(reader):
    ahead = ReadAhead(reader)
    order = [4, 2, 0, 3, 1]
    assert [*ahead.each(order)] == [10 * index for index in order]
    assert sorted(reader.read) == sorted(order)
    assert threading.get_ident() not in reader.threads
    assert len(reader.threads) <= 3


def test_no_more_items_are_read_ahead_than_there_are_threads_and_two(reader):
    ahead = ReadAhead(reader)
    ahead.announce(count())
    ahead._pool.shutdown(wait=True)
    assert sorted(reader.read) == [0, 1, 2, 3, 4]


def test_items_that_were_not_announced_are_read_when_they_are_taken(reader):
    assert ReadAhead(reader).take(7) == 10 * 7
    assert reader.threads == {threading.get_ident()}


def test_another_order_replaces_the_one_before(reader):
    ahead = ReadAhead(reader)
    reader.go.clear()
    ahead.announce([0, 1, 2, 3, 4])
    ahead.announce([8, 9])
    reader.go.set()
    assert ahead.take(8) == 10 * 8
    ahead._pool.shutdown(wait=True)
    assert not {3, 4} & set(reader.read)  # no thread had begun to read these


def test_a_discarded_item_is_read_again(reader):
    ahead = ReadAhead(reader)
    ahead.announce([5])
    ahead.discard(5)
    ahead.take(5)
    ahead._pool.shutdown(wait=True)
    assert 1 <= reader.read.count(5) <= 2
    assert threading.get_ident() in reader.threads


def test_an_error_is_raised_where_the_item_is_taken(reader):
    ahead = ReadAhead(reader)
    ahead.announce([12, 13, 14])
    ahead.take(12)
    with pytest.raises(ValueError, match="frame 13 is damaged"):
        ahead.take(13)
    assert ahead.take(14) == 10 * 14


def test_processes_share_the_cores(reader, monkeypatch):
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    ahead = ReadAhead(reader)
    ahead.announce(count())
    ahead._pool.shutdown(wait=True)
    assert sorted(reader.read) == [0, 1, 2]
    assert len(reader.threads) == 1
