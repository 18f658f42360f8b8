"""Videos are complete or absent, have the right colours, and play in browsers."""

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from warpgs.video import writer

H, W = 20, 32
BLACK = np.zeros((H, W, 3), np.uint8)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mp4"


def write(path, images, *rate):
    with writer.Video(path, *rate) as video:
        for image in images:
            video.add(image)


def frames_of(path):
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(read[1])
    return frames


def test_a_video_has_every_frame_in_order(path):
    write(path, [BLACK + np.uint8(value) for value in (20, 120, 220)])
    assert [frame.mean() for frame in frames_of(path)] == pytest.approx([20, 120, 220], abs=6)


def test_a_video_keeps_red_red(path):
    write(path, [BLACK + np.array([255, 0, 0], np.uint8)])
    blue, green, red = frames_of(path)[0].mean((0, 1))
    assert red > 200
    assert max(blue, green) < 50


COLORS = [(200, 40, 40), (40, 200, 40), (40, 40, 200), (255, 255, 255), (0, 0, 0), (180, 90, 20)]


@pytest.mark.parametrize("size", [(48, 64), (720, 1280)])
def test_players_show_the_colors_of_the_pixels(path, size):
    """OpenCV and FFmpeg convert by the tags of the file, as players do."""
    write(path, [np.broadcast_to(np.array(color, np.uint8), (*size, 3)) for color in COLORS])
    with av.open(str(path)) as file:
        by_ffmpeg = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    by_opencv = [frame[..., ::-1] for frame in frames_of(path)]
    for shown in (by_ffmpeg, by_opencv):
        assert np.abs(np.array(shown).mean((1, 2)) - COLORS).max() <= 3


def test_a_video_is_tagged_as_bt709_of_limited_range(path):
    write(path, [BLACK])
    assert b"colrnclx" in path.read_bytes()
    with av.open(str(path)) as file:
        frame = next(file.decode(video=0))
        assert (frame.color_range, frame.colorspace, frame.color_primaries, frame.color_trc) == (1, 1, 1, 1)


def test_a_video_of_odd_size_loses_its_last_row_and_column(path):
    write(path, [np.zeros((21, 33, 3), np.uint8)])
    assert frames_of(path)[0].shape == (20, 32, 3)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("suffix", ["mp4", "gif", "webp"])
def test_an_unfinished_video_leaves_no_file(tmp_path, suffix, error):
    def images():
        yield BLACK
        raise error

    with pytest.raises(error):
        write(tmp_path / f"a.{suffix}", images())
    assert list(tmp_path.iterdir()) == []


def test_an_error_before_the_first_frame_leaves_the_old_video_unchanged(path):
    path.write_bytes(b"old")
    with pytest.raises(ValueError, match="wrong"), writer.Video(path):
        raise ValueError("wrong")
    assert path.read_bytes() == b"old"


def test_a_video_without_frames_leaves_no_file(tmp_path, path):
    write(path, [])
    assert list(tmp_path.iterdir()) == []


def test_the_error_names_a_video_that_cannot_be_opened(path):
    path.mkdir()
    with pytest.raises(OSError, match=r"a\.mp4 could not be written: Is a directory"):
        write(path, [BLACK])


def test_a_full_disk_is_reported_and_leaves_no_video(tmp_path, path):
    """Every write to /dev/full fails."""
    (tmp_path / "a.mp4.partial").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"a\.mp4 could not be written: No space left on device"):
        write(path, [BLACK])
    assert list(tmp_path.iterdir()) == []


def test_browsers_can_play_the_video(path):
    """H.264 in yuv420p, with the index in front."""
    write(path, [BLACK])
    data = path.read_bytes()
    with av.open(str(path)) as file:
        assert (file.streams[0].codec_context.name, file.streams[0].pix_fmt) == ("h264", "yuv420p")
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_video_has_the_requested_frame_rate(path):
    write(path, [BLACK] * 3, 29.97)
    with av.open(str(path)) as file:
        assert float(file.streams[0].average_rate) == pytest.approx(29.97, abs=0.01)


@pytest.mark.parametrize("shape", [(1, 32, 3), (20, 1, 3)])
def test_a_frame_too_small_for_a_video_is_refused(tmp_path, path, shape):
    with pytest.raises(ValueError, match="a video needs at least 2 × 2 pixels"):
        write(path, [np.zeros(shape, np.uint8)])
    assert list(tmp_path.iterdir()) == []


def test_a_video_has_its_name_only_when_it_is_complete(tmp_path, path):
    path.write_bytes(b"old")
    with writer.Video(path) as video:
        video.add(BLACK)
        assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    assert len(frames_of(path)) == 1


def test_a_missing_h264_encoder_is_reported(tmp_path, path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with pytest.raises(OSError, match=r"a\.mp4 cannot be written: the FFmpeg .* has no libx264"):
        write(path, [BLACK])
    assert list(tmp_path.iterdir()) == []


def test_a_transparent_frame_is_refused_for_mp4(tmp_path, path):
    with pytest.raises(ValueError, match="MP4 has no transparency"):
        write(path, [np.zeros((H, W, 4), np.uint8)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animation_of_odd_size_keeps_all_pixels_and_their_colors(tmp_path, suffix):
    image = np.zeros((21, 33, 3), np.uint8)
    image[:, :16], image[:, 16:] = (200, 40, 40), (40, 40, 200)
    write(tmp_path / f"a.{suffix}", [image, image])
    with Image.open(tmp_path / f"a.{suffix}") as file:
        shown = np.asarray(file.convert("RGB")).astype(int)
    assert shown.shape == (21, 33, 3)
    assert np.abs(shown - image)[:, [*range(12), *range(20, 33)]].max() <= 6


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_every_animation_of_a_process_repeats(tmp_path, suffix):
    for name in ("first", "second"):
        write(tmp_path / f"{name}.{suffix}", [BLACK, BLACK + np.uint8(200)])
        with Image.open(tmp_path / f"{name}.{suffix}") as file:
            assert file.info["loop"] == 0
