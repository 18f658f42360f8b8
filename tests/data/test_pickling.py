"""A capture in another process has the same frames."""

import multiprocessing
import pickle

import pytest
import torch

from tests.data import captures, layouts
from warpgs.captures.opening import load_capture
from warpgs.data.resized import reduced_capture


def test_a_frame_that_a_capture_does_not_have_is_told_a_similar_one(data):
    capture = load_capture(data)
    with pytest.raises(KeyError) as raised:
        capture.frame("rihgt_000004")
    assert str(raised.value) == f"{capture.name} has no view 'rihgt_000004'; did you mean 'right_000004'?"
    with pytest.raises(KeyError, match="has no view 'nope'; its first is 'right_0"):
        capture.frame("nope")


DATASETS = {name: lambda root, name=name: captures.write_capture(root, name) for name in captures.FACTORS}
SOURCES = {**layouts.WRITERS, **DATASETS}


@pytest.mark.parametrize("layout", SOURCES)
def test_a_capture_of_any_layout_is_pickled_with_its_frames(tmp_path, layout):
    capture = load_capture(SOURCES[layout](tmp_path / "source"))
    assert_the_same(pickle.loads(pickle.dumps(capture)), capture)


def assert_the_same(copy, capture):
    assert (copy.train, copy.val, copy.median_depth, copy.assumption) == (
        capture.train, capture.val, capture.median_depth, capture.assumption
    )  # fmt: skip
    for name in (capture.train[0], capture.train[-1], *capture.val[:1]):
        a, b = copy.frame(name), capture.frame(name)
        assert torch.equal(a.camera.viewmat, b.camera.viewmat)
        assert torch.equal(a.camera.K, b.camera.K)
        assert (a.camera.size, a.camera.time) == (b.camera.size, b.camera.time)
        for field in ("image", "static_mask", "inverse_depth", "covisible", "empty"):
            one, other = getattr(a, field), getattr(b, field)
            assert (one is None) == (other is None)
            assert one is None or torch.equal(one.nan_to_num(), other.nan_to_num())


def test_captures_that_were_changed_are_pickled_as_they_are(data):
    capture = load_capture(data)
    capture.frame(capture.train[0])  # in the cache
    moved = {capture.train[0]: capture.cameras[capture.train[1]]}
    dynamic = capture.assuming("dynamic").with_cameras(moved).split(capture.train[:2], capture.val[:1])
    for changed in (dynamic, reduced_capture(capture, 16), capture.over((0.1, 0.2, 0.3))):
        assert_the_same(pickle.loads(pickle.dumps(changed)), changed)


def test_a_copy_of_a_capture_shares_its_cache_of_frames(data):
    capture = load_capture(data)
    assert capture.assuming("dynamic").assuming("masks").frame(capture.train[0]) is capture.frame(capture.train[0])


def brightness(capture, name):
    return float(capture.frame(name).image.float().mean())


def test_a_spawned_process_reads_the_frames_of_a_capture(data):
    capture = load_capture(data)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (found,) = pool.starmap(brightness, [(capture, capture.train[0])])
    assert found == brightness(capture, capture.train[0])
