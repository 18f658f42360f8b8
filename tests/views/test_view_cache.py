"""Decoded views come back from their file bit for bit, and a full disk only costs time."""

import dataclasses
import errno
import shutil
import threading
import weakref
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from tests import tiny
from tests.scenes import generator
from warpgs.captures.opening import load_capture
from warpgs.views.pixels import Pixels
from warpgs.views.view_cache import SPARE_BYTES, ViewCache
from warpgs.views.views import Views

SIZES = [(7, 5), (8, 4), (7, 5)]


def pixels(index, border=True, depth=True):
    g, (width, height) = generator(index), SIZES[index]
    values = torch.rand(height, width, generator=g)
    return Pixels(
        torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8),
        torch.rand(height, width, generator=g) > 0.5,
        torch.where(values > 0.7, torch.nan, values if depth else torch.nan).half(),
        torch.rand(height, width, generator=g) > 0.5 if border else None,
    )


def assert_equal(a, b):
    for left, right in zip(a, b, strict=True):
        assert (left is None) == (right is None)
        if left is not None:
            assert left.dtype == right.dtype
            assert torch.equal(left.nan_to_num(-1.0), right.nan_to_num(-1.0))


@pytest.mark.parametrize("border", [True, False])
@pytest.mark.parametrize("depth", [True, False])
def test_views_come_back_bit_for_bit(tmp_path, border, depth):
    cache, views = ViewCache(tmp_path, SIZES), [pixels(k, border, depth) for k in range(3)]
    for k in (2, 0, 1):
        cache.store(k, views[k])
    for k in (1, 2, 0, 1):
        assert_equal(cache.load(k, pinned=False)[0], views[k])
    size = sum(file.seek(0, 2) for file in cache._files)
    assert size == cache.nbytes if border and depth else size < cache.nbytes


@pytest.fixture
def cache(tmp_path):
    """A cache that has the first view."""
    made = ViewCache(tmp_path, SIZES)
    assert made.store(0, pixels(0))
    return made


@pytest.mark.usefixtures("cache")
def test_the_file_has_no_name(tmp_path):
    assert [*tmp_path.iterdir()] == []


def test_a_view_that_was_never_stored_is_missing(cache):
    assert cache.load(1, pinned=False) is None


def test_a_stored_view_is_only_overwritten_on_request_or_by_one_with_more_changes(cache):
    second = pixels(2)._replace(inverse_depth=pixels(0).inverse_depth * 2)
    assert cache.store(0, second)
    assert_equal(cache.load(0, pinned=False)[0], pixels(0))
    assert cache.store(0, second, replace=True)
    assert_equal(cache.load(0, pinned=False)[0], second)
    assert cache.store(0, pixels(0), version=1)
    assert cache.store(0, second, version=0)
    found, version = cache.load(0, pinned=False)
    assert_equal(found, pixels(0))
    assert version == 1


def test_a_disk_that_becomes_full_keeps_what_was_stored_before(cache):
    def write(data):
        raise OSError(errno.ENOSPC, "No space left on device")

    file = cache._files[1]
    cache._files[1] = SimpleNamespace(write=write, seek=file.seek, readinto=file.readinto)
    assert not cache.store(1, pixels(1))
    assert cache.load(1, pinned=False) is None
    assert_equal(cache.load(0, pinned=False)[0], pixels(0))


def test_a_disk_without_room_stores_nothing(tmp_path, monkeypatch):
    free = ViewCache(tmp_path, SIZES).nbytes + SPARE_BYTES
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    cache = ViewCache(tmp_path, SIZES)
    assert not cache.fits
    cache.store(0, pixels(0))
    assert cache.load(0, pinned=False) is None


def test_what_must_stay_free_is_kept_while_the_disk_fills(cache, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=SPARE_BYTES))
    cache.store(1, pixels(1))
    assert cache.load(1, pinned=False) is None
    assert_equal(cache.load(0, pinned=False)[0], pixels(0))


def test_a_cut_file_is_an_error(cache):
    cache._files[0].truncate(3)
    with pytest.raises(OSError, match="cannot be read"):
        cache.load(0, pinned=False)


# Changes of depth -----------------------------------------------------------------------------------------------------


class Decoder:
    """The frames of a capture with depth, and how often each was decoded."""

    def __init__(self, folder):
        self.source, self.count = load_capture(tiny.write(folder), cache_frames=1), Counter()
        self.capture = dataclasses.replace(self.source, read=self, cache_frames=0)

    def __call__(self, name):
        self.count[name] += 1
        return self.source.read(name)

    def views(self, resident_bytes=0):
        return Views(self.capture, torch.device("cpu"), resident_bytes, mask_margin=0.05)


@pytest.fixture
def decoder(tmp_path):
    return Decoder(tmp_path)


def change_twice(views):
    """Changes the depth of every view: the known one by a factor, and then that of dynamic pixels without it."""
    alignment = torch.tensor([2.0, 0.5])
    for index, view in enumerate(views):
        height, width = view.inverse_depth.shape
        factor = torch.linspace(0.8, 1.2, height * width).view(height, width)
        views.set_depth_factor(index, alignment, factor.where(view.static_mask, torch.nan))
        views.set_object_depth(index, alignment, torch.rand(height // 2, width // 2, generator=generator(index)) + 0.5)


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_frames_are_decoded_once_even_if_their_depth_changes(decoder, resident_bytes):
    views = decoder.views(resident_bytes)
    change_twice(views)
    for _ in range(2):
        assert len([*views]) == len(decoder.capture.train)
    assert decoder.count == dict.fromkeys(decoder.capture.train, 1)


@pytest.mark.parametrize("disk", ["has space", "becomes full", "is full"])
def test_changed_depth_is_that_of_resident_views_bit_for_bit(decoder, monkeypatch, disk):
    plain, resident = decoder.views(1 << 30), decoder.views(1 << 30)
    change_twice(resident)
    free = {"has space": 1 << 50, "becomes full": 1 << 50, "is full": 0}[disk]
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    views = decoder.views()
    assert len([*views]) == len(resident)
    if disk == "becomes full":
        free = SPARE_BYTES
    change_twice(views)
    for index in range(len(views)):
        assert_equal(views[index][1:], resident[index][1:])
        assert not torch.equal(views[index].inverse_depth, plain[index].inverse_depth)


def test_factors_of_depth_do_not_stay_in_memory(decoder):
    views = decoder.views()
    factor = torch.full(views[0].inverse_depth.shape, 2.0).half()
    alive = weakref.ref(factor)
    views.set_depth_factor(0, torch.tensor([1.0, 0.0]), factor)
    del factor
    assert alive() is None
    assert not views._reader._changed_depth


@pytest.mark.parametrize("step", ["load", "store"])
def test_depth_that_changes_while_a_thread_reads_the_view_is_not_lost(decoder, monkeypatch, step):
    """The thread stops before or after it decodes the view; the depth changes; then the thread goes on."""
    views, has_begun, go_on = decoder.views(), threading.Event(), threading.Event()
    before, act = decoder.views()[1].inverse_depth, getattr(ViewCache, step)

    def stopped(cache, *arguments, **options):
        if threading.current_thread() is not threading.main_thread():
            has_begun.set()
            assert go_on.wait(10.0)
        return act(cache, *arguments, **options)

    monkeypatch.setattr(ViewCache, step, stopped)
    views.announce([1])
    assert has_begun.wait(10.0)
    views.set_depth_factor(1, torch.tensor([1.0, 0.0]), torch.full_like(before, 2.0))
    go_on.set()
    views._read_ahead._pool.shutdown(wait=True)
    assert_equal([views._reader.read(1).inverse_depth], [(2.0 * before).half()])
    assert_equal([views._read_ahead.take(1).inverse_depth], [(2.0 * before).half()])


def test_a_view_that_is_being_replaced_is_read_before_or_after(cache):
    """Never in part, whatever the depth: one of the two has none."""
    views = [pixels(0), pixels(0, depth=False)]
    with ThreadPoolExecutor(2) as pool:
        writes = [pool.submit(cache.store, 0, views[k % 2], replace=True) for k in range(200)]
        for _ in range(200):
            found, _ = cache.load(0, pinned=False)
            assert_equal(found, views[int(found.inverse_depth.isnan().all())])
    assert all(write.result() for write in writes)
