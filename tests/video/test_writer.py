"""Videos are complete or absent, have the right colours, and play in browsers."""

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from warpgs.video import writer

H, W = 20, 32


def frames_of(path):
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(read[1])
    return frames


def test_a_video_has_every_frame_in_order(tmp_path):
    with writer.Video(tmp_path / "a.mp4") as video:
        for value in (20, 120, 220):
            video.add(np.full((H, W, 3), value, np.uint8))
    assert [frame.mean() for frame in frames_of(tmp_path / "a.mp4")] == pytest.approx([20, 120, 220], abs=6)


def test_a_video_keeps_red_red(tmp_path):
    red = np.zeros((H, W, 3), np.uint8)
    red[..., 0] = 255
    with writer.Video(tmp_path / "a.mp4") as video:
        video.add(red)
    blue, green, red_again = frames_of(tmp_path / "a.mp4")[0].mean((0, 1))
    assert red_again > 200
    assert max(blue, green) < 50


COLORS = [(200, 40, 40), (40, 200, 40), (40, 40, 200), (255, 255, 255), (0, 0, 0), (180, 90, 20)]


@pytest.mark.parametrize("size", [(48, 64), (720, 1280)])
def test_players_show_the_colors_of_the_pixels(tmp_path, size):
    """OpenCV and FFmpeg convert by the tags of the file, as players do."""
    with writer.Video(tmp_path / "a.mp4") as video:
        for color in COLORS:
            video.add(np.broadcast_to(np.array(color, np.uint8), (*size, 3)))
    with av.open(str(tmp_path / "a.mp4")) as file:
        by_ffmpeg = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    by_opencv = [frame[..., ::-1] for frame in frames_of(tmp_path / "a.mp4")]
    for shown in (by_ffmpeg, by_opencv):
        assert np.abs(np.array(shown).mean((1, 2)) - COLORS).max() <= 3


def test_a_video_is_tagged_as_bt709_of_limited_range(tmp_path):
    with writer.Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((H, W, 3), np.uint8))
    assert b"colrnclx" in (tmp_path / "a.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as file:
        frame = next(file.decode(video=0))
        assert (frame.color_range, frame.colorspace, frame.color_primaries, frame.color_trc) == (1, 1, 1, 1)


def test_a_video_of_odd_size_loses_its_last_row_and_column(tmp_path):
    with writer.Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((21, 33, 3), np.uint8))
    assert frames_of(tmp_path / "a.mp4")[0].shape == (20, 32, 3)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("suffix", ["mp4", "gif", "webp"])
def test_an_unfinished_video_leaves_no_file(tmp_path, suffix, error):
    def fail():
        with writer.Video(tmp_path / f"a.{suffix}") as video:
            video.add(np.zeros((H, W, 3), np.uint8))
            raise error

    with pytest.raises(error):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_an_error_before_the_first_frame_leaves_the_old_video_unchanged(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(ValueError, match="wrong"), writer.Video(tmp_path / "a.mp4"):
        raise ValueError("wrong")
    assert (tmp_path / "a.mp4").read_bytes() == b"old"


def test_a_video_without_frames_leaves_no_file(tmp_path):
    with writer.Video(tmp_path / "a.mp4"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_the_error_names_a_video_that_cannot_be_opened(tmp_path):
    (tmp_path / "a.mp4").mkdir()
    with (
        pytest.raises(OSError, match=r"a\.mp4 could not be written: Is a directory"),
        writer.Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))


def test_a_full_disk_is_reported_and_leaves_no_video(tmp_path):
    """Every write to /dev/full fails."""
    (tmp_path / "a.mp4.partial").symlink_to("/dev/full")
    with (
        pytest.raises(OSError, match=r"a\.mp4 could not be written: No space left on device"),
        writer.Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_browsers_can_play_the_video(tmp_path):
    """H.264 in yuv420p, with the index in front."""
    with writer.Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((H, W, 3), np.uint8))
    data = (tmp_path / "a.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as file:
        assert (file.streams[0].codec_context.name, file.streams[0].pix_fmt) == ("h264", "yuv420p")
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_video_has_the_requested_frame_rate(tmp_path):
    with writer.Video(tmp_path / "a.mp4", 29.97) as video:
        for _ in range(3):
            video.add(np.zeros((H, W, 3), np.uint8))
    with av.open(str(tmp_path / "a.mp4")) as file:
        assert float(file.streams[0].average_rate) == pytest.approx(29.97, abs=0.01)


@pytest.mark.parametrize("shape", [(1, 32, 3), (20, 1, 3)])
def test_a_frame_too_small_for_a_video_is_refused(tmp_path, shape):
    with (
        pytest.raises(ValueError, match="a video needs at least 2 × 2 pixels"),
        writer.Video(tmp_path / "a.mp4") as video,
    ):
        video.add(np.zeros(shape, np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_a_video_has_its_name_only_when_it_is_complete(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with writer.Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((H, W, 3), np.uint8))
        assert (tmp_path / "a.mp4").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert len(frames_of(tmp_path / "a.mp4")) == 1


def test_a_missing_h264_encoder_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with (
        pytest.raises(OSError, match=r"a\.mp4 cannot be written: the FFmpeg .* has no libx264"),
        writer.Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_a_transparent_frame_is_refused_for_mp4(tmp_path):
    with pytest.raises(ValueError, match="MP4 has no transparency"), writer.Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((H, W, 4), np.uint8))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animation_of_odd_size_keeps_all_pixels_and_their_colors(tmp_path, suffix):
    image = np.zeros((21, 33, 3), np.uint8)
    image[:, :16], image[:, 16:] = (200, 40, 40), (40, 40, 200)
    with writer.Video(tmp_path / f"a.{suffix}") as video:
        for _ in range(2):
            video.add(image)
    with Image.open(tmp_path / f"a.{suffix}") as file:
        shown = np.asarray(file.convert("RGB")).astype(int)
    assert shown.shape == (21, 33, 3)
    assert np.abs(shown - image)[:, [*range(12), *range(20, 33)]].max() <= 6


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_every_animation_of_a_process_repeats(tmp_path, suffix):
    for name in ("first", "second"):
        with writer.Video(tmp_path / f"{name}.{suffix}") as video:
            for value in (0, 200):
                video.add(np.full((H, W, 3), value, np.uint8))
        with Image.open(tmp_path / f"{name}.{suffix}") as file:
            assert file.info["loop"] == 0
