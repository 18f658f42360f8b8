"""Frames of a video by index: threads that read them roughly in order decode it once."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.prepare.boards import write_video
from warpgs.data.video_frames import NUM_KEPT, VideoFrames

NUM = 40


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A video whose frames become brighter."""
    images = [np.full((32, 32, 3), 6 * k, np.uint8) for k in range(NUM)]
    return write_video(tmp_path_factory.mktemp("video") / "clip.mp4", images)


@pytest.fixture(scope="module")
def index_of(path):
    """Says which frame an image is."""
    frames = VideoFrames(path)
    images = [frames.read(k) for k in range(NUM)]
    return lambda image: next(k for k in range(NUM) if np.array_equal(images[k], image))


@pytest.fixture
def video(path, index_of, monkeypatch):
    """The video, and how often it was decoded from the begin."""
    passes, decoded = [], VideoFrames._decoded
    monkeypatch.setattr(VideoFrames, "_decoded", lambda self: passes.append(0) or decoded(self))
    return VideoFrames(path), passes


def test_threads_read_the_right_frames(video, index_of):
    with ThreadPoolExecutor(4) as pool:
        assert [index_of(image) for image in pool.map(video[0].read, range(NUM))] == list(range(NUM))


def test_frames_roughly_in_order_take_one_pass(video, index_of):
    frames, passes = video
    order = sorted(range(NUM), key=lambda k: (k // NUM_KEPT, -k))
    assert [index_of(frames.read(k)) for k in order] == order
    assert len(passes) == 1


def test_a_frame_that_is_a_little_late_is_still_there(video, index_of):
    frames, passes = video
    assert [index_of(frames.read(k)) for k in (20, 20 - NUM_KEPT + 1, 21)] == [20, 20 - NUM_KEPT + 1, 21]
    assert len(passes) == 1


def test_an_earlier_frame_is_decoded_again_and_no_more_are_kept(video, index_of):
    frames, passes = video
    assert [index_of(frames.read(k)) for k in (30, 3, 30)] == [30, 3, 30]
    assert len(passes) == 2
    assert len(frames._kept) == NUM_KEPT


def test_damage_is_the_same_error_for_earlier_frames(path, tmp_path):
    data = path.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(data)
    frames = VideoFrames(cut)
    cut.write_bytes(b"no video")
    frames._restart()
    for index in (11, 10):
        with pytest.raises(ValueError, match="is damaged or not a video"):
            frames.read(index)


def test_a_frame_after_the_end_is_an_error(video, index_of):
    with pytest.raises(ValueError, match=f"has {NUM} frames, no frame {NUM}"):
        video[0].read(NUM)
    assert index_of(video[0].read(NUM - 1)) == NUM - 1
