"""When several videos start, from their sound or as given."""

import contextlib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from tests.prepare import event
from warpgs.prepare.frames import offsets, sound
from warpgs.prepare.frames.offsets import Clock, check_offsets, common_clock
from warpgs.prepare.frames.sound import Match, Onsets
from warpgs.prepare.options import Options, Selection

SECONDS = 6.0
"""Length of the videos."""

IMAGES = [np.full((16, 16, 3), 40 * k % 256, np.uint8) for k in range(int(SECONDS * event.RATE))]


def write(path: Path, start: float, *, seed: int | None = 0, rate: int = 48_000, gain: float = 0.5) -> Path:
    """A video that hears an event from this time on; without a seed, it has no sound."""
    if seed is None:
        return event.write_video(path, IMAGES)
    return event.write_video(path, IMAGES, event.heard(event.sound(seed), start, SECONDS, rate, gain), rate)


def test_sound_tells_when_videos_start_whatever_their_gain_noise_and_rate(tmp_path):
    videos = [
        write(tmp_path / "a.mp4", 3.0),
        write(tmp_path / "b.mp4", 3.37, rate=44_100, gain=0.1),
        write(tmp_path / "c.mp4", 1.5, rate=16_000, gain=0.3),
    ]
    clock, note = common_clock(videos, None)
    assert np.allclose(clock.starts, [1.5, 1.87, 0.0], atol=0.002)
    assert clock.begin == clock.starts[1]
    assert clock.end == pytest.approx(SECONDS - 1 / event.RATE)
    assert note == "the videos start at a.mp4 1.500 s, b.mp4 1.870 s, c.mp4 0.000 s, from their sound"


def test_sound_that_begins_later_than_the_images_is_heard_later(tmp_path):
    late = event.heard(event.sound(), 4.0, SECONDS - 1.0)
    b = event.write_video(tmp_path / "b.mp4", IMAGES, late, sound_from=1.0)
    assert common_clock([write(tmp_path / "a.mp4", 3.0), b], None)[0].starts == pytest.approx([0.0, 0.0], abs=0.002)


def test_sound_that_ends_early_is_sufficient(tmp_path):
    b = event.write_video(tmp_path / "b.mp4", IMAGES, event.heard(event.sound(), 3.4, 2.0))
    assert common_clock([write(tmp_path / "a.mp4", 3.0), b], None)[0].starts == pytest.approx([0.0, 0.4], abs=0.002)


@pytest.mark.parametrize("part", [(0.0, 0.4), (0.3, 0.6), (0.5, 1.0)])
def test_what_is_damaged_of_a_sound_is_skipped(tmp_path, part):
    a, b = write(tmp_path / "a.mp4", 3.0), write(tmp_path / "b.mp4", 3.4)
    with av.open(str(b)) as container:
        packets = [(p.pos, p.size) for p in container.demux(container.streams.audio[0]) if p.size]
    data, random = bytearray(b.read_bytes()), np.random.default_rng(0)
    for begin, size in packets[int(part[0] * len(packets)) : int(part[1] * len(packets))]:
        data[begin : begin + size] = random.bytes(size)
    b.write_bytes(data)
    assert common_clock([a, b], None)[0].starts == pytest.approx([0.0, 0.4], abs=0.002)


def test_a_sound_may_change_its_rate(tmp_path):
    first = event.write_video(tmp_path / "1.ts", IMAGES, event.heard(event.sound(), 3.4, 3.0))
    second = event.heard(event.sound(), 6.4, 3.0, 44_100)
    second = event.write_video(tmp_path / "2.ts", IMAGES, second, 44_100, sound_from=3.0)
    both = tmp_path / "both.ts"
    both.write_bytes(first.read_bytes() + second.read_bytes())
    part, whole = (sound.read_onsets(path, Fraction(0)) for path in (first, both))
    assert sound.compare([part, whole])[0, 1].offset == pytest.approx(0.0, abs=0.002)
    assert (part.values.shape[1], whole.values.shape[1]) == pytest.approx((750, 1500), abs=20)


def test_a_sound_that_cannot_be_decoded_is_named(tmp_path, monkeypatch):
    def fail(**options: object) -> None:
        raise ValueError("unknown\nformat")

    videos = [write(tmp_path / "a.mp4", 3.0), write(tmp_path / "b.mp4", 3.4)]
    monkeypatch.setattr(av, "AudioResampler", fail)
    with pytest.raises(ValueError, match=r"^the sound of .*a\.mp4 cannot be decoded: unknown format; give the time"):
        common_clock(videos, None)


def test_a_video_is_placed_by_another_one_than_the_first(tmp_path):
    """The first and the last have nothing in common but the one between them."""
    videos = [write(tmp_path / f"{k}.mp4", start) for k, start in enumerate((2.0, 5.0, 8.0))]
    with pytest.raises(ValueError, match=r"2\.mp4 starts 6\.00 s after .*0\.mp4, which takes only 5\.88 s: they have"):
        common_clock(videos, None)


def find(monkeypatch: pytest.MonkeyPatch, **matches: tuple[float, float]) -> list[float]:
    """The offsets of three videos of which each pair, such as ab, has an offset and a ratio."""
    compared = {("abc".index(pair[0]), "abc".index(pair[1])): Match(*match) for pair, match in matches.items()}
    monkeypatch.setattr(offsets, "read_onsets", lambda *rest: Onsets(np.ones((1, 9)), 0.0))
    monkeypatch.setattr(offsets, "compare", lambda onsets: compared)
    return offsets.find_offsets([Path(f"{name}.mp4") for name in "abc"], [Fraction(0)] * 3)


def test_a_video_is_placed_by_the_one_that_it_resembles_most(monkeypatch):
    """What is not certain does not count, however far off it is."""
    assert find(monkeypatch, ab=(1.0, 5.0), bc=(-3.0, 4.0), ac=(9.0, 1.9)) == [0.0, 1.0, -2.0]
    assert find(monkeypatch, ab=(1.0, 2.5), bc=(-3.0, 4.0), ac=(-1.98, 3.0)) == pytest.approx([0.0, 1.02, -1.98])


def test_sounds_that_contradict_each_other_are_refused(monkeypatch):
    message = r"a\.mp4, but -2\.00 s as other videos say; give the time"
    with pytest.raises(ValueError, match=r"the sounds contradict each other: c\.mp4 starts 0\.50 s after " + message):
        find(monkeypatch, ab=(1.0, 5.0), bc=(-3.0, 4.0), ac=(0.5, 2.1))


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        (None, r"c\.mp4 has no sound, which tells when it starts: give .* with --offset, such as --offset 0,0\.37"),
        (5, r"the sound of .*c\.mp4 does not tell when it starts \(found: a\.mp4 0\.00 s, b\.mp4 0\.37 s\): give"),
    ],
)
def test_a_video_whose_sound_does_not_tell_when_it_starts_is_named(tmp_path, seed, message):
    videos = [write(tmp_path / "a.mp4", 3.0), write(tmp_path / "b.mp4", 3.37), write(tmp_path / "c.mp4", 3, seed=seed)]
    with pytest.raises(ValueError, match=message):
        common_clock(videos, None)


def test_a_first_video_of_another_event_is_named(tmp_path):
    videos = [write(tmp_path / "a.mp4", 3, seed=5), write(tmp_path / "b.mp4", 3.0), write(tmp_path / "c.mp4", 3.37)]
    with pytest.raises(
        ValueError, match=r"the sound of .*a\.mp4 does not .* \(found: b\.mp4 0\.00 s, c\.mp4 0\.37 s\)"
    ):
        common_clock(videos, None)


def test_of_two_videos_that_hear_different_things_both_are_named(tmp_path):
    videos = [write(tmp_path / "a.mp4", 3.0), write(tmp_path / "b.mp4", 3.37, seed=5)]
    with pytest.raises(ValueError, match=r"the sounds of .*a\.mp4 and .*b\.mp4 do not tell when they start: give"):
        common_clock(videos, None)


@pytest.mark.parametrize(("needed", "is_refused"), [(3, False), (4, True)])
def test_a_video_that_ends_too_early_is_named_whichever_it_is(tmp_path, needed, is_refused):
    short = event.write_video(tmp_path / "short.mp4", IMAGES[:3])
    for videos in ([write(tmp_path / "a.mp4", 0, seed=None), short], [short, write(tmp_path / "a.mp4", 0, seed=None)]):
        message = r"the videos show only 0\.25 s together, the length of .*short\.mp4: 3 frames of .*, at least 4 are"
        with pytest.raises(ValueError, match=message) if is_refused else contextlib.nullcontext():
            common_clock(videos, [0.0, 0.0], needed=needed)


def test_sounds_too_short_to_compare_other_lags_tell_nothing():
    a, b = (np.random.default_rng(k).random(255) for k in (0, 1))
    sums = [np.concatenate([[0.0], np.cumsum(x**2)]) for x in (a, b)]
    correlation = np.fft.irfft(np.fft.rfft(a, 512) * np.fft.rfft(b, 512).conj())
    assert sound._peak(correlation, *sums)[1] == 0.0


def test_silence_is_no_sound(tmp_path):
    silent = event.write_video(tmp_path / "b.mp4", IMAGES, np.zeros(48_000 * 6))
    with pytest.raises(ValueError, match=r"b\.mp4 has no sound"):
        common_clock([write(tmp_path / "a.mp4", 3.0), silent], None)


def test_given_offsets_need_no_sound_and_only_their_differences_count(tmp_path):
    videos = [write(tmp_path / "a.mp4", 0, seed=None), write(tmp_path / "b.mp4", 0, seed=None)]
    clock, note = common_clock(videos, [2.0, 0.5])
    assert clock.starts == [1.5, 0.0]
    assert note.endswith("as given")


def test_videos_of_one_name_in_several_folders_are_told_apart_by_their_paths(tmp_path):
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
    videos = [write(tmp_path / name, 0, seed=None) for name in ("left/a.mp4", "right/a.mp4", "b.mp4")]
    note = common_clock(videos, [2.0, 0.5, 1.0])[1]
    assert note == f"the videos start at {videos[0]} 1.500 s, {videos[1]} 0.000 s, b.mp4 0.500 s, as given"


def test_given_offsets_larger_than_a_video_are_refused(tmp_path):
    videos = [write(tmp_path / "a.mp4", 0, seed=None), write(tmp_path / "b.mp4", 0, seed=None)]
    with pytest.raises(ValueError, match=r"b\.mp4 starts 7\.00 s after .*a\.mp4, which takes only 5\.88 s: they have"):
        common_clock(videos, [0.0, 7.0])


def test_a_part_is_taken_of_the_time_that_all_videos_show():
    clock = Clock([0.0, 1.5], begin=1.5, end=6.0)
    first, second = (clock.selection(k, Selection(start=1.0, end=3.0)) for k in (0, 1))
    assert (first.start, first.end) == pytest.approx((2.5, 4.5), abs=1e-5)
    assert (second.start, second.end) == pytest.approx((1.0, 3.0), abs=1e-5)
    with pytest.raises(ValueError, match=r"the videos show 4\.5 s together: no frame is in the part from --start on"):
        clock.selection(0, Selection(start=5.0))


@pytest.mark.parametrize(
    ("offset", "count", "message"),
    [
        ("0,x", 2, "--offset must be numbers of seconds, separated by commas, got 0,x"),
        ("0,1,2", 2, "--offset must be a time for each of the 2 videos, separated by commas, got 0,1,2"),
        ("0,inf", 2, "--offset must be a time for each of the 2 videos"),
        ("0", 1, "--offset is for several videos"),
    ],
)
def test_offsets_that_are_no_times_are_refused(offset, count, message):
    with pytest.raises(ValueError, match=message):
        check_offsets(Options(offset=offset).offsets, count)
