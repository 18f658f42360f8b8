"""Decoded views come back from their file bit for bit, and a full disk only costs time."""

import dataclasses
import errno
import shutil
from collections import Counter
from types import SimpleNamespace

import pytest
import torch

from tests import tiny
from tests.scenes import generator
from warpgs.data.loaders import load_capture
from warpgs.training.view_cache import SPARE_BYTES, Pixels, ViewCache
from warpgs.training.views import Views

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
        assert_equal(cache.load(k, pinned=False), views[k])
    assert cache._file.seek(0, 2) <= cache.nbytes


def test_the_file_has_no_name(tmp_path):
    cache = ViewCache(tmp_path, SIZES)
    cache.store(0, pixels(0))
    assert [*tmp_path.iterdir()] == []


def test_a_forgotten_view_and_one_that_was_never_stored_are_missing(tmp_path):
    cache = ViewCache(tmp_path, SIZES)
    cache.store(0, pixels(0))
    cache.forget(0)
    assert cache.load(0, pinned=False) is None
    assert cache.load(1, pinned=False) is None


def test_a_disk_that_becomes_full_keeps_what_was_stored_before(tmp_path, monkeypatch):
    cache = ViewCache(tmp_path, SIZES)
    cache.store(0, pixels(0))

    def write(data):
        raise OSError(errno.ENOSPC, "No space left on device")

    file = cache._file
    monkeypatch.setattr(cache, "_file", SimpleNamespace(write=write, seek=file.seek, readinto=file.readinto))
    cache.store(1, pixels(1))
    assert cache.load(1, pinned=False) is None
    assert_equal(cache.load(0, pinned=False), pixels(0))


def test_a_disk_without_room_stores_nothing(tmp_path, monkeypatch):
    free = ViewCache(tmp_path, SIZES).nbytes + SPARE_BYTES
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    cache = ViewCache(tmp_path, SIZES)
    assert not cache.fits
    cache.store(0, pixels(0))
    assert cache.load(0, pinned=False) is None


def test_what_must_stay_free_is_kept_while_the_disk_fills(tmp_path, monkeypatch):
    cache = ViewCache(tmp_path, SIZES)
    cache.store(0, pixels(0))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=SPARE_BYTES))
    cache.store(1, pixels(1))
    assert cache.load(1, pinned=False) is None
    assert_equal(cache.load(0, pinned=False), pixels(0))


def test_a_cut_file_is_an_error(tmp_path):
    cache = ViewCache(tmp_path, SIZES)
    cache.store(0, pixels(0))
    cache._file.truncate(3)
    with pytest.raises(OSError, match="cannot be read"):
        cache.load(0, pinned=False)


def test_frames_are_decoded_once_until_their_depth_changes(tmp_path):
    source = load_capture(tiny.write(tmp_path), cache_frames=1)
    decoded = Counter()

    def read(name):
        decoded[name] += 1
        return source.read(name)

    capture = dataclasses.replace(source, read=read, cache_frames=1)
    views = Views(capture, torch.device("cpu"), resident_bytes=0)
    for _ in range(3):
        assert len([*views]) == len(capture.train)
    assert set(decoded.values()) <= {1, 2}  # the first one also tells how large views are
    assert sum(decoded.values()) <= len(capture.train) + 1

    before = views[0].inverse_depth
    factor = torch.full_like(before, 2.0)
    views.set_depth_factor(0, torch.tensor([1.0, 0.0]), factor)
    torch.testing.assert_close(views[0].inverse_depth, 2.0 * before, rtol=1e-3, atol=0.0, equal_nan=True)
