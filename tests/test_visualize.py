"""Pictures for people: what is written is what was drawn."""

import errno
import os
import sys

import av
import cv2
import numpy as np
import pytest
import torch

from warpgs import visualize as pictures
from warpgs.files import write_png
from warpgs.rendering import Layer, Rendering

H, W = 20, 32


def layer(value):
    return Layer(torch.full((H, W, 3), value), torch.ones(H, W), None)


@pytest.fixture
def rendering():
    nothing = torch.zeros(0, 2)
    return Rendering(layer(0.2), layer(0.4), layer(0.6), nothing.int(), nothing, None, None)


def colorful():
    return np.random.default_rng(0).integers(0, 256, (H, W, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("value", "byte"), [(0.0, 0), (1.0, 255), (-0.5, 0), (7.0, 255), (0.5, 128), (1.4 / 255, 1), (1.6 / 255, 2)]
)
def test_bytes_are_rounded_and_kept_in_range(value, byte):
    assert (pictures.to_bytes(torch.full((H, W, 3), value)) == byte).all()


def test_bytes_of_a_trained_image_need_no_detaching():
    assert pictures.to_bytes(torch.zeros(H, W, 3, requires_grad=True)).shape == (H, W, 3)


def test_error_is_brighter_where_it_is_larger():
    truth = torch.zeros(H, W, 3)
    image = torch.linspace(0, pictures.ERROR_RANGE, W)[None, :, None].expand(H, W, 3)
    brightness = pictures.error_image(image, truth).astype(int).sum(2)
    assert (np.diff(brightness, axis=1)[:, 1:] >= 0).all()
    assert brightness[0, 0] < 20
    assert brightness[0, -1] > 600


def test_error_is_the_same_both_ways():
    a, b = torch.rand(H, W, 3), torch.rand(H, W, 3)
    assert (pictures.error_image(a, b) == pictures.error_image(b, a)).all()


def test_error_above_its_range_has_the_brightest_colour():
    most = pictures.error_image(torch.full((H, W, 3), pictures.ERROR_RANGE), torch.zeros(H, W, 3))
    assert (pictures.error_image(torch.ones(H, W, 3), torch.zeros(H, W, 3)) == most).all()


def test_a_comparison_shows_truth_joint_static_dynamic_and_error_in_that_order(rendering):
    sheet = pictures.comparison(torch.full((H, W, 3), 1.0), rendering)
    below = sheet[pictures.CAPTION_HEIGHT :]
    assert below.shape == (H, 5 * W, 3)
    assert [int(below[5, k * W + 5, 0]) for k in range(4)] == [255, 51, 102, 153]
    error = pictures.error_image(rendering.joint.image, torch.full((H, W, 3), 1.0))
    assert (below[:, 4 * W :] == error).all()


def test_every_picture_of_a_comparison_has_a_caption(rendering):
    bar = pictures.comparison(torch.ones(H, W, 3), rendering)[: pictures.CAPTION_HEIGHT]
    assert all(bar[:, k * W : (k + 1) * W].max() > 100 for k in range(5))


# Files --------------------------------------------------------------------------------------------------------------


def test_a_png_holds_the_picture_exactly_in_rgb(tmp_path):
    picture = colorful()
    write_png(tmp_path / "new folder" / "a.png", picture)
    stored = cv2.imread(str(tmp_path / "new folder" / "a.png"))
    assert (stored[..., ::-1] == picture).all()


def full_disk(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_png_that_can_not_be_written_leaves_the_old_one_and_is_named(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match=rf"{path} could not be written: No space left on device$"):
        write_png(path, colorful())
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def frames_of(path):
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(read[1])
    return frames


def test_a_video_has_every_frame_in_order(tmp_path):
    with Video(tmp_path / "a.mp4") as video:
        for value in (20, 120, 220):
            video.add(np.full((H, W, 3), value, np.uint8))
    assert [frame.mean() for frame in frames_of(tmp_path / "a.mp4")] == pytest.approx([20, 120, 220], abs=6)


def test_a_video_keeps_red_red(tmp_path):
    red = np.zeros((H, W, 3), np.uint8)
    red[..., 0] = 255
    with Video(tmp_path / "a.mp4") as video:
        video.add(red)
    blue, green, red_again = frames_of(tmp_path / "a.mp4")[0].mean((0, 1))
    assert red_again > 200
    assert max(blue, green) < 50


def test_a_video_of_odd_size_loses_its_last_row_and_column(tmp_path):
    with Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((21, 33, 3), np.uint8))
    assert frames_of(tmp_path / "a.mp4")[0].shape == (20, 32, 3)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_video_that_was_not_finished_is_no_file(tmp_path, error):
    def fail():
        with Video(tmp_path / "a.mp4") as video:
            video.add(np.zeros((H, W, 3), np.uint8))
            raise error

    with pytest.raises(error):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_an_error_before_the_first_frame_leaves_the_old_video_alone(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(ValueError, match="wrong"), Video(tmp_path / "a.mp4"):
        raise ValueError("wrong")
    assert (tmp_path / "a.mp4").read_bytes() == b"old"


def test_a_video_without_frames_is_no_file(tmp_path):
    with Video(tmp_path / "a.mp4"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_can_not_be_opened_is_named(tmp_path):
    (tmp_path / "a.mp4").mkdir()
    with (
        pytest.raises(OSError, match=r"a\.mp4 could not be written: Is a directory"),
        Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))


def test_a_disk_that_is_full_is_told_and_leaves_no_video(tmp_path):
    """/dev/full says of every write that there is no room."""
    (tmp_path / "a.mp4.partial").symlink_to("/dev/full")
    with (
        pytest.raises(OSError, match=r"a\.mp4 could not be written: No space left on device"),
        Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_browsers_play_what_is_written(tmp_path):
    """H.264 with half as many colours a side, the index in front."""
    with Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((H, W, 3), np.uint8))
    data = (tmp_path / "a.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as file:
        assert (file.streams[0].codec_context.name, file.streams[0].pix_fmt) == ("h264", "yuv420p")
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_video_has_the_rate_asked_for(tmp_path):
    with Video(tmp_path / "a.mp4", 29.97) as video:
        for _ in range(3):
            video.add(np.zeros((H, W, 3), np.uint8))
    with av.open(str(tmp_path / "a.mp4")) as file:
        assert float(file.streams[0].average_rate) == pytest.approx(29.97, abs=0.01)


@pytest.mark.parametrize("shape", [(1, 32, 3), (20, 1, 3)])
def test_a_picture_too_small_for_a_video_is_refused(tmp_path, shape):
    with (
        pytest.raises(ValueError, match="a video needs two pixels a side"),
        Video(tmp_path / "a.mp4") as video,
    ):
        video.add(np.zeros(shape, np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_a_video_has_its_name_only_when_it_is_whole(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with Video(tmp_path / "a.mp4") as video:
        video.add(np.zeros((H, W, 3), np.uint8))
        assert (tmp_path / "a.mp4").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert len(frames_of(tmp_path / "a.mp4")) == 1


def test_without_ffmpeg_a_line_says_where_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with (
        pytest.raises(OSError, match="a video needs FFmpeg, which comes with PyAV: pip install av"),
        Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))


def test_without_an_encoder_for_h264_a_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with (
        pytest.raises(OSError, match=r"a\.mp4 can't be written: the FFmpeg .* has no libx264"),
        Video(tmp_path / "a.mp4") as v,
    ):
        v.add(np.zeros((H, W, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
