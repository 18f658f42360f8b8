"""The video that ships: it is written, shows parallax and motion, and errors are one line."""

import itertools

import av
import numpy as np
import pytest

from warpgs.prepare.frames import sample
from warpgs.prepare.frames.sample import SampleSize, write_sample

TINY = SampleSize(96, 64, 10, 1)


def test_the_video_has_its_size_its_frames_and_its_rate(tmp_path):
    path = tmp_path / "sample.mp4"
    write_sample(path, TINY)
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == sample.RATE
    assert np.shape(images) == (10, 64, 96, 3)
    assert all(np.std(image) > 20 for image in images)
    assert all(np.abs(a.astype(int) - b).mean() > 3 for a, b in itertools.pairwise(images))


def test_the_static_scene_is_seen_from_different_places_and_something_moves():
    size = SampleSize(96, 64, 2, 1)
    cameras = [sample._camera(time, size).position for time in (0.0, 1.0)]
    assert (cameras[0] - cameras[1]).norm() > 1.5
    first, second = sample._moving(0.0), sample._moving(0.5)
    assert all(np.linalg.norm(np.subtract(a.center, b.center)) > 0.5 for a, b in zip(first, second, strict=True))


def test_the_scene_is_the_same_every_time():
    assert [body.center for body in sample._clutter()] == [body.center for body in sample._clutter()]


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("a.avi", TINY, r"a\.avi must end with \.mp4"),
        ("a.mp4", SampleSize(96, 64, 9), "needs 10 frames of 64×64 pixels at least"),
        ("a.mp4", SampleSize(96, 63), "needs 10 frames of 64×64 pixels at least"),
        ("a.mp4", SampleSize(num_samples=0), "needs 10 frames"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is_traced(name, size, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        write_sample(tmp_path / name, size)
    assert not any(tmp_path.iterdir())


def test_what_is_traced_is_said_first_unless_it_is_quiet(tmp_path, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(sample, "_frame", lambda *a, frame=sample._frame: said.append(len(said)) or frame(*a))
    path = tmp_path / "sample.mp4"
    write_sample(path, TINY, log=lambda line: said.append(line))
    assert said[0] == f"tracing 10 frames of 96×64 for {path}"
    capsys.readouterr()
    write_sample(tmp_path / "quiet.mp4", TINY)
    assert capsys.readouterr() == ("", "")


def test_a_video_that_exists_is_kept(tmp_path):
    path = tmp_path / "sample.mp4"
    path.write_bytes(b"mine")
    with pytest.raises(ValueError, match=r"sample\.mp4 exists: give another name"):
        write_sample(path, TINY)
    assert path.read_bytes() == b"mine"
