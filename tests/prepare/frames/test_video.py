"""Videos as phones record them: variable frame rates, ranges and matrices of colour, HDR, cuts, long ones."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from tests.prepare.boards import record, texture, write_video
from warpgs.prepare.frames.colors import HLG, PQ, srgb_from_hdr
from warpgs.prepare.frames.cuts import CutFinder
from warpgs.prepare.frames.timeline import plan_timeline
from warpgs.prepare.frames.video import read_video
from warpgs.prepare.options import Selection

LIMITED, FULL = 1, 2
BT709, BT2020 = 1, 9


@pytest.fixture(scope="module")
def images():
    return record(20)[0]


def encode(path, images, times=None, pixel_format="yuv444p", **tags):
    """A lossless H.264 video of RGB images [H, W, 3], or of YUV planes [3, H, W], with time stamps in milliseconds."""
    height, width = images[0].shape[:2] if images[0].shape[-1] == 3 else images[0].shape[1:]
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", 30, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for k, image in enumerate(images):
            if image.shape[-1] == 3:
                frame = av.VideoFrame.from_ndarray(image, "rgb24").reformat(format=pixel_format)
            else:
                frame = av.VideoFrame(width, height, pixel_format)
                for plane, values in zip(frame.planes, image, strict=True):
                    plane.update(values.tobytes())
            for name, value in tags.items():
                setattr(frame, name, value)
            frame.pts, frame.time_base = round(1000 * k / 30) if times is None else times[k], Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


def read(path, **selection):
    notes: list[str] = []
    return list(read_video(path, Selection(**selection), True, notes)), notes


def test_frames_of_a_variable_rate_have_their_own_times(tmp_path, images):
    times = [0, 33, 66, 100, 300, 333, 366, 900]
    taken, _ = read(encode(tmp_path / "v.mp4", images[:8], times))
    assert [frame.time for frame in taken] == times


def test_intervals_of_a_variable_rate_have_equal_durations(tmp_path, images):
    times = [*range(0, 1000, 100), *range(1000, 3000, 400)]
    taken, _ = read(encode(tmp_path / "v.mp4", images[: len(times)], times), fps=1.0)
    assert [frame.time // 1000 for frame in taken] == [0, 1, 2]


def yuv(level: float, chroma: tuple[float, float], full: bool, size: int = 64) -> np.ndarray:
    """[3, H, W] 8-bit planes of Y in [0, 1] and Cb, Cr in [-0.5, 0.5]."""
    scales = (0.0, 255.0, 255.0) if full else (16.0, 219.0, 224.0)
    values = [scales[0] + scales[1] * level, *(128.0 + scales[2] * c for c in chroma)]
    return np.stack([np.full((size, size), round(v), np.uint8) for v in values])


@pytest.mark.parametrize("full", [False, True])
def test_full_and_limited_range_give_the_same_levels(full, tmp_path):
    planes = [yuv(0.5, (0.0, 0.0), full)] * 5
    taken, _ = read(encode(tmp_path / "v.mp4", planes, color_range=FULL if full else LIMITED))
    assert np.abs(taken[2].image.astype(int) - 127.5).max() < 2.0


def matrix_planes(red: float, blue: float) -> list[np.ndarray]:
    """Planes of pure red, with the weights of red and blue of the matrix."""
    return [yuv(red, (-0.5 * red / (1.0 - blue), 0.5), False)] * 5


@pytest.mark.parametrize(
    ("matrix", "weights"), [(BT709, (0.2126, 0.0722)), (5, (0.299, 0.114)), (BT2020, (0.2627, 0.0593))]
)
def test_the_stated_matrix_is_used(matrix, weights, tmp_path):
    taken, _ = read(encode(tmp_path / "v.mp4", matrix_planes(*weights), colorspace=matrix))
    assert np.abs(taken[2].image.astype(int) - [255, 0, 0]).max() < 4


def test_reference_white_has_the_same_level_in_hlg_and_pq():
    hlg = srgb_from_hdr(np.full((1, 1, 3), round(0.75 * 65535), np.uint16), HLG)
    pq = srgb_from_hdr(np.full((1, 1, 3), round(0.5807 * 65535), np.uint16), PQ)
    assert np.abs(hlg.astype(int) - pq).max() <= 1
    assert 230 < hlg.min() < 255


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_hdr_becomes_brighter_monotonically_and_ends_at_white(transfer):
    ramp = np.repeat(np.linspace(0, 65535, 100).astype(np.uint16)[None, :, None], 3, -1)
    levels = srgb_from_hdr(ramp, transfer)[0, :, 1].astype(int)
    assert levels[0] == 0
    assert levels[-1] >= 254
    assert (np.diff(levels) >= 0).all()


def test_red_of_bt709_in_hdr_stays_red():
    """BT.709 red at 50 cd/m² in BT.2020 primaries (BT.2087), encoded with PQ."""
    light = 50.0 / 10_000.0 * np.array([0.6274, 0.0691, 0.0164])
    power = light ** (2610 / 16384)
    code = ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    red, green, blue = srgb_from_hdr((65535 * code).round().astype(np.uint16)[None, None], PQ)[0, 0].astype(int)
    assert red > 100
    assert max(green, blue) < 12


def test_an_hdr_video_is_converted_by_its_tags(tmp_path):
    """Reference white, 75 % of HLG, in 10 bits of limited range."""
    planes = [np.stack([np.full((64, 64), v, np.uint16) for v in (64 + round(0.75 * 876), 512, 512)])] * 5
    video = encode(tmp_path / "v.mp4", planes, pixel_format="yuv444p10le", color_trc=HLG, colorspace=BT2020)
    taken, _ = read(video)
    expected = srgb_from_hdr(np.full((1, 1, 3), round(0.75 * 65535), np.uint16), HLG)
    assert np.abs(taken[2].image.astype(int) - expected).max() <= 2


def test_a_cut_is_named_with_its_frame(tmp_path, images):
    other = [image[::-1, ::-1, ::-1] // 2 for image in record(10, travel=0.5)[0]]
    _, notes = read(write_video(tmp_path / "cut.mp4", [*images[:9], *other], rate=10.0))
    assert len(notes) == 1
    assert "has a cut at frame 9 (0.90 s)" in notes[0]
    assert read(write_video(tmp_path / "whole.mp4", images))[1] == []


def greys(*levels: int) -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    shots = {level: generator.integers(0, 256, (27, 48)).astype(np.uint8) for level in sorted(set(levels))}
    return [shots[level] for level in levels]


@pytest.mark.parametrize(
    ("levels", "cuts"), [((0, 0, 0, 1, 1, 1), [3]), ((0, 0, 1, 0, 0, 0), []), ((0, 1, 2, 3, 4, 5), [])]
)
def test_a_single_other_frame_and_constant_change_are_no_cuts(levels, cuts):
    finder = CutFinder()
    for k, grey in enumerate(greys(*levels)):
        finder.add(k, k / 10.0, grey)
    assert [step for step, _ in finder.found] == cuts


def pan(*positions: tuple[int, int]) -> list[np.ndarray]:
    """What a camera sees of one of two long walls, from these columns on."""
    walls = [cv2.cvtColor(texture(seed, (150, 140, 120), 900, (20, 60, 200)), cv2.COLOR_RGB2GRAY) for seed in (3, 4)]
    return [walls[wall][300:480, column : column + 320] for wall, column in positions]


def cuts_of(frames: list[np.ndarray]) -> list[int]:
    finder = CutFinder()
    for k, grey in enumerate(frames):
        finder.add(k, k / 10.0, grey)
    return [step for step, _ in finder.found]


@pytest.mark.parametrize("jump", [60, 110, 150, -140])
def test_a_pan_that_drops_frames_is_no_cut(jump):
    """The frames beside the gap correlate with their neighbours, but not with each other."""
    before, after = [200, 206, 212], [212 + jump, 218 + jump, 224 + jump]
    assert cuts_of(pan(*((0, column) for column in before + after))) == []
    assert cuts_of(pan(*((0, column) for column in before), *((1, column) for column in after))) == [3]


def test_a_part_of_a_video_is_taken(tmp_path, images):
    taken, _ = read(write_video(tmp_path / "v.mp4", images, rate=10.0), start=0.5, end=1.2)
    assert [frame.step for frame in taken] == [*range(5, 13)]
    assert [frame.time for frame in taken] == [*range(500, 1300, 100)]


def test_a_part_after_the_end_is_refused(tmp_path, images):
    with pytest.raises(ValueError, match=r"ends after 1\.9 s: no frame is in the part"):
        read(write_video(tmp_path / "v.mp4", images, rate=10.0), start=7.0)


def test_more_than_a_thousand_frames_are_refused_with_the_options_that_help():
    times = [Fraction(k, 30) for k in range(2000)]
    with pytest.raises(ValueError, match=r"long\.mp4 gives 2000 frames, the maximum is 1000: .*--start.*--fps"):
        plan_timeline("long.mp4", times, Selection(fps=30.0))
    assert len(set(plan_timeline("long.mp4", times, Selection(fps=30.0, end=20.0)).intervals.values())) == 601
    assert len(set(plan_timeline("long.mp4", times, Selection()).intervals.values())) == 150


def test_a_playlist_may_not_name_other_places(tmp_path):
    (tmp_path / "list.m3u8").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n")
    with pytest.raises(ValueError, match="is not a video"):
        read(tmp_path / "list.m3u8")
