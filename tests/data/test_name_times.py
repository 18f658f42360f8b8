"""Times of frames are read from their names where these tell them, and their source is said."""

import json

import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, write_json
from warpgs.captures.check import check_capture, require_fit
from warpgs.captures.import_capture import import_capture
from warpgs.captures.opening import load_capture
from warpgs.data.loaders.name_times import times_of_names
from warpgs.data.time_source import TimeSource, with_steps
from warpgs.files import natural_order

SECOND = 10**9
START = 1305031102 * SECOND + 850 * 10**6
STEP = 133_333_333
"""Nanoseconds from frame to frame; the second changes after two frames, and the third has few nanoseconds."""


STAMPS = {
    "TUM": lambda k, s, n: f"rgb/{s}.{n // 1000:06d}.png",
    "TUM without trailing zeros": lambda k, s, n: f"{START // SECOND + 1 + round(STEP * k / SECOND, 3)}.png",
    "nanoseconds": lambda k, s, n: f"mav0/cam0/data/{s}{n:09d}.png",
    "microseconds": lambda k, s, n: f"{s}{n // 1000:06d}.jpg",
    "milliseconds": lambda k, s, n: f"frame{s}{n // 10**6:03d}.jpg",
    "seconds and nanoseconds": lambda k, s, n: f"frame_{s}_{n:09d}.png",
    "seconds and nanoseconds without zeros": lambda k, s, n: f"{s}_{n}.png",
    "a point and nanoseconds without zeros": lambda k, s, n: f"{s}.{n}.png",
    "joined nanoseconds without zeros": lambda k, s, n: f"{s}{n}.png",
    "a number and a time stamp": lambda k, s, n: f"image{k}_{s}_{n}.png",
    "seconds of a simulation": lambda k, s, n: f"{s - 1305031093}_{n:09d}.png",
    "decimal seconds after an id": lambda k, s, n: f"41069021_{99.85 + k * STEP / SECOND:.3f}.png",
    "Pixel phones": lambda k, s, n: f"PXL_20240131_1422{s - 1305031070:02d}{n // 10**6:03d}.MP.jpg",
    "milliseconds after a date": lambda k, s, n: f"IMG_20240131_142233_{100 + STEP * k // 10**6:03d}.jpg",
    "VLC": lambda k, s, n: f"vlcsnap-2024-01-31-14h22m33s{100 + STEP * k // 10**6}.png",
}


@pytest.mark.parametrize("kind", STAMPS)
def test_time_stamps_are_read_as_seconds(kind):
    index = {STAMPS[kind](k, *divmod(START + k * STEP, SECOND)): k for k in range(7)}
    names = sorted(index, key=natural_order)
    times, source, are_read, _ = times_of_names(names)
    assert are_read
    assert np.allclose(times, [index[name] * STEP / SECOND for name in names], atol=2e-3)
    assert source == TimeSource("times from the time stamps in the names, 0.133 s apart")


DATES = [
    "IMG_20240131_14{:02d}{:02d}.jpg",
    "2024-01-31 14.{:02d}.{:02d}.jpg",
    "Screenshot 2024-01-31 at 14.{:02d}.{:02d}.png",
    "WIN_20240131_14_{:02d}_{:02d}_Pro.jpg",
    "2024-01-31T14:{:02d}:{:02d}.jpg",
    "DJI_2024013114{:02d}{:02d}_0007_D.JPG",
    "frame_14{:02d}{:02d}.png",
    "14-{:02d}-{:02d}.png",
    "vlcsnap-14h{:02d}m{:02d}s000.png",
]


@pytest.mark.parametrize("pattern", DATES)
def test_dates_are_read_across_minutes(pattern):
    times = times_of_names([pattern.format(*divmod(22 * 60 + 52 + 4 * k, 60)) for k in range(5)]).times
    assert times == [0.0, 4.0, 8.0, 12.0, 16.0]


@pytest.mark.parametrize(
    "pattern", ["{:02d}-{:02d}-{:02d}.png", "frame_{:02d}{:02d}{:02d}.png", "{:02d}h{:02d}m{:02d}s"]
)
def test_times_of_day_without_a_date_go_on_after_midnight_and_that_is_said(pattern):
    names = sorted(pattern.format(s // 3600 % 24, s // 60 % 60, s % 60) for s in range(86_390, 86_420, 2))
    times, source, *_ = times_of_names(names)
    assert times == [*range(10, 30, 2), *range(0, 10, 2)]
    last, first = (pattern.format(*time) for time in ((23, 59, 58), (0, 0, 0)))
    assert source.problem == f"they are taken to go on after midnight, from {last} to {first}"


def test_times_of_day_with_a_long_pause_stay_on_one_day():
    """An hour lies between the last one and midnight."""
    names = [f"{hour:02d}-00-{s:02d}.png" for hour in (0, 23) for s in range(0, 20, 2)]
    times, source, *_ = times_of_names(names)
    assert max(times) < 86_400
    assert times == sorted(times)
    assert "midnight" not in source.problem


NUMBERS = {
    "ns-process-data": ([f"./images/frame_{k:05d}.png" for k in (1, 2, 3)], [0, 1, 2]),
    "dropped frames": (["1", "2", "3", "5", "6"], [0, 1, 2, 4, 5]),
    "sharpest frames": ([f"frame_{k:05d}" for k in (3, 11, 14, 26)], [0, 8, 11, 23]),
    "numbers like the time of day": ([f"{k:06d}.png" for k in (50, 100, 150, 200, 250)], [0, 50, 100, 150, 200]),
    "no padding": (["f2.png", "f10.png"], [0, 8]),
    "some padding": (["f2.png", "f003.png", "f10.png"], [0, 1, 8]),
    "text after the number": ([f"{k:06d}.rgb.png" for k in (4, 5, 7)], [0, 1, 3]),
    "a constant number after it": (["0004_take2024.png", "0006_take2024.png"], [0, 2]),
    "a longer constant number": (["take2024_001.png", "take2024_003.png"], [0, 2]),
    "two suffixes": (["IMG_0001.HEIC.jpg", "IMG_0003.jpg"], [0, 2]),
    "a date and frames": ([f"VID_20240131_142233_frame_{k:05d}.jpg" for k in (0, 12)], [0, 12]),
    "dates and a number that goes on": (
        [f"IMG_20240131_1422{33 + k // 30}_{k:03d}" for k in (9, 40, 99, 130, 200, 201)],
        [0, 31, 90, 121, 191, 192],
    ),
    "a number that goes on in the next clip": (["a1_0008", "a1_0009", "a2_0010"], [0, 1, 2]),
    "cameras": (["cam1_frame_0003", "cam1_frame_0005", "cam2_frame_0003"], [0, 2, 0]),
    "cameras last": (["0003_cam1", "0003_cam2", "0005_cam1"], [0, 0, 2]),
    "cameras without frames": (["cam1_7", "cam2_7"], [0, 0]),
    "folders of cameras": (["0/003.jpg", "0/005.jpg", "1/003.jpg", "1/005.jpg"], [0, 2, 0, 2]),
    "two sides": (["left_0001", "left_0003", "right_0001"], [0, 2, 0]),
    "two sides in turn": (["left_0001", "left_0003", "right_0002"], [0, 2, 1]),
    "frames called cameras": (["camera_0001.png", "camera_0004.png"], [0, 3]),
    "very long numbers": (["9" * 5000 + "1", "9" * 5000 + "3"], [0, 2]),
    "one frame": (["a.png"], [0]),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_numbers_that_tell_frames_apart_are_their_times(kind):
    names, times = NUMBERS[kind]
    found = times_of_names(names)
    assert (found.times, found.source.problem) == (times, "")


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["a.png", "b.png", "c.png"], "a.png has no number"),
        (["img_0_0", "img_0_1", "img_1_0", "img_1_1"], "the numbers in them do not grow from img_0_1 to img_1_0"),
        (["clip1/1", "clip1/2", "clip2/1", "clip2/2"], "the numbers in them do not grow from clip1/2 to clip2/1"),
        (["f3.png", "f003.png"], "the numbers in them do not grow from f3.png to f003.png"),
        (["1/1.png", "1/2.png", "2/1.png", "2/2.png", "3/1.png", "3/2.png"], "do not grow from 1/2.png to 2/1.png"),
        (["20240131_142233", "20240131_142233(1)", "20240131_142234", "20240131_142234(1)"], "do not grow"),
        (["IMG_20240131_142233_1", "IMG_20240131_142233_2", "IMG_20240131_142234_1"], "do not grow"),
        (["IMG_20240131_142233_001", "IMG_20240131_142233_002", "IMG_20240131_142234_001"], "do not grow"),
        ([f"f{k}" for k in (1, 2, 3, 4, 900)], "the numbers in them jump from f4 to f900"),
    ],
)
def test_names_are_counted_where_their_numbers_are_no_times_and_the_reason_is_said(names, reason):
    times, source, are_read, _ = times_of_names(names)
    assert (times, are_read) == ([float(k) for k in range(len(names))], False)
    assert source.text.startswith("times from the sorted order of the names, because ")
    assert reason in source.text
    assert source.problem == "number the images in the order of time if that is wrong"


@pytest.mark.parametrize("prefix", ["DSC_", "DSC0"])
def test_the_counter_of_a_camera_may_begin_again_after_9999(prefix):
    times, source, *_ = times_of_names([f"{prefix}{k:04d}.JPG" for k in (1, 2, 9997, 9998, 9999)])
    assert times == [4.0, 5.0, 0.0, 1.0, 2.0]
    between = f"there are none between {prefix}0002.JPG and {prefix}9997.JPG"
    assert f"begin again after 9999, as {between}" in source.problem


def test_a_long_gap_between_time_stamps_stays_and_is_a_problem():
    times, source, *_ = times_of_names([f"{1305031102 + t:.2f}.png" for t in (0, 0.25, 0.5, 0.75, 90)])
    assert times == [0.0, 0.25, 0.5, 0.75, 90.0]
    assert source.text.endswith("22.5 s apart on average, largest gap 89.2 s")
    assert "nearly all of the time is from 1305031102.75.png to 1305031192.00.png" in source.problem


def with_times(root, times, field="time"):
    """transforms.json with the times of its frames in the order of their names; None for a frame without."""
    path = root / "transforms.json"
    frames = sorted(json.loads(path.read_text())["frames"], key=lambda frame: frame["file_path"])
    for frame, time in zip(frames, times, strict=True):
        frame |= {} if time is None else {field: time}
    edit_json(path, frames=frames)
    return root


def test_a_frame_without_a_time_among_others_is_refused_by_its_name(edited):
    root = with_times(edited("nerfstudio"), [0, 1, 2, None, *range(4, 12)])
    message = f"images/{layouts.NAMES[3]}.png has no time, which 11 of 12 frames have"
    with pytest.raises(ValueError, match=message):
        load_capture(root)


def test_timestamps_of_all_frames_are_preferred_to_times_of_some(edited):
    root = with_times(with_times(edited("nerfstudio"), [None, *range(11)]), [*range(11), 22], "timestamp")
    capture = load_capture(root)
    assert capture.cameras[layouts.NAMES[10]].time == 10 / 22
    expected = "times from the field timestamp of transforms.json, 2 apart on average, largest gap 12"
    assert str(capture.time_source) == expected


@pytest.mark.parametrize("time", [float("nan"), float("inf"), "0.5", True, [1], 1e300])
def test_a_time_that_is_no_finite_number_is_refused_with_the_name_of_its_frame(edited, time):
    root = with_times(edited("nerfstudio"), [*range(11), time])
    with pytest.raises(ValueError, match=f"time of images/{layouts.NAMES[11]}.png must be a finite number") as caught:
        load_capture(root)
    assert len(str(caught.value)) < 400


def test_nanoseconds_in_the_field_time_are_read(edited):
    root = with_times(edited("nerfstudio"), [1_705_031_102_400_000_000 + 33_333_333 * k for k in range(12)])
    assert load_capture(root).cameras[layouts.NAMES[1]].time == pytest.approx(1 / 11, abs=1e-9)


def test_given_times_win_over_names_but_another_order_is_a_problem(edited):
    capture = load_capture(with_times(edited("nerfstudio"), [*range(12, 0, -1)]))
    assert [capture.cameras[name].time for name in (layouts.NAMES[0], layouts.NAMES[11])] == [1.0, 0.0]
    first, second = (f"images/{name}.png" for name in layouts.NAMES[:2])
    assert capture.time_source.problem == (
        f"the numbers in the names have another order: {second} is earlier than {first}"
    )


def test_blender_frames_that_lack_a_time_are_refused(edited):
    root = edited("blender")
    frames = json.loads((root / "transforms_train.json").read_text())["frames"]
    del frames[2]["time"]
    edit_json(root / "transforms_train.json", frames=frames)
    with pytest.raises(ValueError, match=r"r_002 has no time, which 5 of 6 frames have"):
        load_capture(root)


def test_blender_files_of_which_one_lacks_times_are_refused(edited):
    root = edited("blender")
    frames = json.loads((root / "transforms_test.json").read_text())["frames"]
    for frame in frames:
        del frame["time"]
    edit_json(root / "transforms_test.json", frames=frames)
    with pytest.raises(ValueError, match=r"transforms_test\.json: frames have no time, but those of transforms_train"):
        load_capture(root)


def edit_steps(root, edit):
    path = root / "metadata.json"
    write_json(path, {name: edit(name, entry) for name, entry in json.loads(path.read_text()).items()})


def test_times_begin_at_0_whatever_the_first_time_id_is(root):
    before = {name: camera.time for name, camera in load_capture(root).cameras.items()}
    edit_steps(root, lambda name, entry: {**entry, "time_id": entry["time_id"] + 1000})
    capture = load_capture(root)
    assert {name: camera.time for name, camera in capture.cameras.items()} == before
    assert capture.time_source == TimeSource("times from time_id in metadata.json, 1 apart")


def test_warp_ids_are_used_for_all_frames_if_one_lacks_a_time_id(root):
    edit_steps(root, lambda name, entry: {**entry, "time_id": None if name == "left_000001" else 500})
    capture = load_capture(root)
    times = [capture.cameras[f"left_{k:06d}"].time for k in range(4)]
    assert times == [0.0, 1 / 3, 2 / 3, 1.0]
    assert capture.time_source.text.startswith("times from warp_id in metadata.json")
    assert "left_000001 has no time_id" in capture.time_source.problem


@pytest.mark.parametrize("layout", layouts.ALL)
def test_every_layout_says_where_its_times_come_from(written, layout):
    source = load_capture(written[layout]).time_source
    assert source.text.startswith("times from ")
    assert source.problem == ""


def test_the_source_of_times_is_kept_by_copies_of_a_capture(written):
    capture = load_capture(written["nerfstudio"])
    copies = [capture.assuming("static"), capture.over("white"), capture.split(capture.train[:2], ())]
    assert all(copy.time_source == capture.time_source for copy in copies)


def rename(root, name):
    """Images of transforms.json with other names: that of the k-th by ``name(k)``."""
    path = root / "transforms.json"
    frames = sorted(json.loads(path.read_text())["frames"], key=lambda frame: frame["file_path"])
    for k, frame in enumerate(frames):
        (root / frame["file_path"]).rename(root / f"images/{name(k)}.png")
        frame["file_path"] = f"images/{name(k)}.png"
    edit_json(path, frames=frames)
    return root


def test_check_import_and_training_say_where_times_come_from(edited, tmp_path):
    root = rename(edited("nerfstudio"), lambda k: f"{1305031102 + 0.4 * k:.6f}")
    sentence = "times from the time stamps in the names, 0.4 s apart"
    assert f"note: {sentence}" in str(check_capture(root)).splitlines()
    imported, trained = [], []
    import_capture(root, tmp_path / "imported", log=imported.append)
    assert f"note: {sentence}" in imported
    require_fit(load_capture(root), trained.append)
    assert trained.count(sentence) == 1


def test_check_and_training_warn_of_times_that_are_guessed(edited):
    root, lines = rename(edited("nerfstudio"), lambda k: "abcdefghijkl"[k]), []
    require_fit(load_capture(root), lines.append)
    start = "warning: times from the sorted order of the names, because images/a.png has no number; number the images"
    assert sum("times from" in line for line in lines) == 1
    assert any(line.startswith(start) for line in lines)
    assert any(line.startswith(start) for line in str(check_capture(root)).splitlines())


def test_guessed_times_are_no_warning_for_a_scene_without_motion(edited):
    root, lines = rename(edited("nerfstudio"), lambda k: "abcdefghijkl"[k]), []
    require_fit(load_capture(root).assuming("static"), lines.append)
    assert not any("times from" in line for line in lines)


@pytest.mark.parametrize(
    ("times", "unit", "steps"),
    [
        ([0.0, 1.0, 2.0], " frames", "1 frame"),
        ([0.0, 3.0, 6.0], " frames", "3 frames"),
        ([0.0, 1.0], " s", "1 s"),
        ([0.0, 2.0], "", "2"),
    ],
)
def test_equal_steps_have_a_unit_where_it_is_known(times, unit, steps):
    assert with_steps("times", times, unit) == f"times, {steps} apart"


def test_steps_of_frame_numbers_are_in_frames(written):
    assert load_capture(written["vipe"]).time_source.text.endswith(" apart")
    assert " frame" in load_capture(written["vipe"]).time_source.text.rpartition(".mp4")[2]
