"""Several videos of one event become one capture: three cameras, of which one moves, with sound."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.prepare import boards, event
from tests.prepare.event import Filmed
from warpgs.captures.check import check_capture
from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.prepare import pipeline
from warpgs.prepare.cameras.recovered import NoCamerasError, require_cameras
from warpgs.prepare.checks import find_videos
from warpgs.prepare.options import Options, Selection

CAMERAS = [
    Filmed((-1.0, -2.9, 1.3), travel=1.6),
    Filmed((-0.9, -2.6, 1.6), start=0.37, frames=22, focal=0.8),
    Filmed((0.9, -2.7, 1.1), start=0.81, frames=18),
]

RATES, GAINS = (48_000, 44_100, 16_000), (0.5, 0.1, 0.3)

BEGIN = max(camera.start for camera in CAMERAS)
"""Time at which the last camera starts [s]."""

OPTIONS = Options(holdout=6)


@pytest.fixture(scope="module")
def filmed():
    return [event.trace(camera) for camera in CAMERAS]


@pytest.fixture(scope="module")
def videos(filmed, tmp_path_factory):
    folder, sound = tmp_path_factory.mktemp("event"), event.sound()
    return [
        event.write_video(folder / f"{name}.mp4", images, event.heard(sound, 3.0 + camera.start, 3.0, rate, gain), rate)
        for name, camera, (images, _), rate, gain in zip("abc", CAMERAS, filmed, RATES, GAINS, strict=True)
    ]


@pytest.fixture(scope="module")
def made(videos):
    root = videos[0].parent / "capture"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", event.SIZE[0])
        pipeline.prepare(videos, root, OPTIONS)
    return root


def shot(name: str) -> tuple[int, int]:
    """The camera of a frame of the capture, and its index in the video."""
    camera, place = map(int, name.split("_"))
    return camera, place + sum(time < BEGIN for time in CAMERAS[camera].times())


def test_every_frame_says_its_camera_and_its_time_on_the_clock_of_all(made):
    entries = json.loads((made / "metadata.json").read_text())
    assert {name: entry["camera_id"] for name, entry in entries.items()} == {name: shot(name)[0] for name in entries}
    times = {name: CAMERAS[camera].times()[k] for name in entries for camera, k in [shot(name)]}
    first = min(times.values())
    assert all(abs(entries[name]["time_id"] - 1000 * (times[name] - first)) <= 3 for name in entries)
    assert {name[0] for name in entries} == {"0", "1", "2"}


def test_all_cameras_are_found_in_one_world(made):
    capture = load_capture(made)
    names = sorted(capture.cameras)
    truth = np.array([CAMERAS[c].camera(CAMERAS[c].times()[k]).position.numpy() for c, k in map(shot, names)])
    found = np.array([capture.cameras[name].position.numpy() for name in names], np.float64)
    distances = boards.distances(found, truth.astype(np.float64)) / np.ptp(truth, axis=0).max()
    assert distances.max() < 0.02
    focals = {name[0]: float(capture.cameras[name].K[0, 0]) / capture.cameras[name].width for name in names}
    # With seeds of its own for each pair of frames, COLMAP's focal lengths are still up to 2.2 % off in some runs.
    assert [focals[k] for k in "012"] == pytest.approx([camera.focal for camera in CAMERAS], rel=0.03)


def test_a_camera_that_stands_still_has_one_pose(made):
    cameras = load_capture(made).cameras
    moved = {k: np.ptp([cameras[n].viewmat.numpy() for n in cameras if n[0] == k], axis=0).max() for k in "012"}
    assert moved["0"] > 0.1
    assert moved["1"] == moved["2"] == 0.0


def test_what_moves_is_masked_in_each_camera(made, filmed):
    capture = load_capture(made)
    for camera in range(3):
        frames = [capture.frame(name) for name in capture.cameras if shot(name)[0] == camera]
        truth = [filmed[camera][1][shot(frame.name)[1]] for frame in frames]
        overlaps = [boards.overlap(~f.static_mask.numpy(), mask) for f, mask in zip(frames, truth, strict=True)]
        assert np.mean(overlaps) > 0.7


def test_frames_of_each_camera_are_held_out(made):
    capture = load_capture(made)
    assert len(capture.cameras) == 3 * 17
    assert [sum(name.startswith(f"{k}_") for name in capture.val) for k in range(3)] == [3, 3, 3]


def test_cameras_that_stand_still_have_no_depth_and_each_has_rows_of_thumbnails(made):
    assert {path.stem[0] for path in (made / "depth/1x").iterdir()} == {"0"}
    height, width = cv2.imread(str(made / "masks.png")).shape[:2]
    assert (width // 256, height // 144) == (6, 3)


def test_the_report_says_which_cameras_move_and_when_they_start(made):
    report = json.loads((made / "prepare.json").read_text())
    assert report["steps"]["frames"] == (
        "17 of 320×180 of a.mp4 (0), which moves; 17 of 320×180 of b.mp4 (1), which stands still; "
        "17 of 320×180 of c.mp4 (2), which stands still; "
        "the videos start at a.mp4 0.000 s, b.mp4 0.370 s, c.mp4 0.810 s, from their sound"
    )
    assert report["source"] == [str(made.parent / f"{name}.mp4") for name in "abc"]


def test_the_capture_is_fit_to_train_on(made):
    assert check_capture(made).is_fit


def test_a_finished_capture_is_not_made_again(made, videos):
    before = (made / "dataset.json").stat().st_mtime_ns
    pipeline.prepare(videos, made, OPTIONS)
    assert (made / "dataset.json").stat().st_mtime_ns == before


@pytest.fixture(scope="module")
def resumed(videos):
    """The capture of a preparation that was interrupted, of the frames of one camera for evaluation."""

    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    root = videos[0].parent / "resumed"
    options = Options(masks="none", depth="none", selection=Selection(count=6), holdout_camera=("b",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warpgs.prepare.steps.write_capture", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pipeline.prepare(videos, root, options)
    with pytest.MonkeyPatch.context() as patch:
        for finished in ("take_videos", "recover_several"):
            patch.setattr(f"warpgs.prepare.steps.{finished}", interrupted)
        pipeline.prepare(videos, root, options)
    return load_capture(root)


def test_after_an_interruption_finished_steps_are_skipped(resumed):
    assert len(resumed.cameras) == 18


def test_a_whole_camera_is_held_out(resumed):
    assert sorted(resumed.val) == [f"1_{k:06d}" for k in range(6)]
    assert len(resumed.train) == 12


def test_cameras_that_all_stand_still_are_found_from_an_image_each(tmp_path):
    """17° apart around the middle, with small images."""
    angles = [-0.3, 0.0, 0.3, 0.6]
    rig = [Filmed((3.4 * np.sin(a), 0.4 - 3.4 * np.cos(a), 1.2), frames=6) for a in angles]
    videos = [event.write_video(tmp_path / f"{k}.mp4", event.trace(camera)[0]) for k, camera in enumerate(rig)]
    lines = []
    options = Options(masks="none", offset="0,0,0,0", selection=Selection(count=6))
    pipeline.prepare(videos, tmp_path / "made", options, log=lines.append)
    capture = load_capture(tmp_path / "made")
    found = np.array([capture.cameras[f"{k}_000000"].position.numpy() for k in range(4)], np.float64)
    truth = np.array([camera.camera(0.0).position.numpy() for camera in rig], np.float64)
    assert boards.distances(found, truth).max() < 0.05 * np.ptp(truth, axis=0).max()
    assert "depth: none, because no camera moves" in lines[-2]
    assert "look at masks.png in it" in lines[-1]


def test_a_camera_without_a_common_view_is_named(videos, tmp_path):
    other = event.write_video(tmp_path / "other.mp4", boards.record(24, moves=False)[0])
    options = Options(masks="none", offset="0,0.37,0", selection=Selection(count=6))
    with pytest.raises(NoCamerasError, match=r"other\.mp4 shares no view with .*a\.mp4 and .*b\.mp4: too"):
        pipeline.prepare([*videos[:2], other], tmp_path / "made", options)


def test_cameras_of_videos_that_are_called_alike_are_counted_each_by_itself():
    with pytest.raises(NoCamerasError, match=r"a\.mp4 shares no view with a\.mp4: too"):
        require_cameras([6, 0], [6, 6], ["a.mp4", "a.mp4"])


def test_a_video_without_texture_is_named(videos, tmp_path):
    blank = event.write_video(tmp_path / "blank.mp4", [np.full((180, 320, 3), 90, np.uint8)] * 24)
    options = Options(masks="none", offset="0,0.37", selection=Selection(count=6))
    with pytest.raises(NoCamerasError, match=r"the frames of .*blank\.mp4 have hardly any texture: 0 features"):
        pipeline.prepare([videos[0], blank], tmp_path / "made", options)


@pytest.mark.parametrize(
    ("sources", "options", "message"),
    [
        (["a.mp4", "a.mp4"], {}, "a.mp4 is given twice"),
        (["a.mp4", "b.mp5"], {}, "b.mp5 is missing: expected a video; did you mean .*b.mp4"),
        (["a.mp4", "."], {}, "is a folder: several sources must be videos"),
        (["a.mp4", "b.mp4"], {"camera": "still"}, "--camera still is for one video: of several, each may move or"),
        (["a.mp4", "b.mp4"], {"offset": "1"}, "--offset must be a time for each of the 2 videos"),
        (["a.mp4", "b.mp4"], {"offset": "0,9"}, "b.mp4 starts 9.00 s after .*a.mp4, which takes only"),
        (
            ["a.mp4", "b.mp4"],
            {"offset": "0,2"},
            "the videos show only 0.88 s together, from the start of .*b.mp4 to the",
        ),
        (["a.mp4"], {"offset": "0"}, "--offset is for several videos"),
        (
            ["a.mp4", "b.mp4"],
            {"holdout_camera": ("d",)},
            "--holdout-camera must be one of a.mp4, b.mp4, got 'd'",
        ),
        (["a.mp4", "b.mp4"], {"holdout_camera": ("a", "b.mp4")}, "--holdout-camera a b.mp4 leaves no camera to train"),
        (["a.mp4"], {"holdout_camera": ("a",)}, "--holdout-camera a leaves no camera to train on"),
    ],
)
def test_several_videos_that_do_not_fit_are_refused(videos, tmp_path, sources, options, message):
    paths = [videos[0].parent / source for source in sources]
    with pytest.raises(ValueError, match=message):
        pipeline.prepare(paths, tmp_path / "made", Options(**options))
    assert not (tmp_path / "made" / "rgb").exists()


def test_a_focal_length_of_videos_of_several_sizes_is_refused(videos, tmp_path):
    small = event.write_video(tmp_path / "small.mp4", [np.zeros((90, 160, 3), np.uint8)] * 24)
    options = Options(focal=250.0, offset="0,0")
    with pytest.raises(ValueError, match="--focal and --intrinsics are of all videos, which have several sizes"):
        pipeline.prepare([videos[0], small], tmp_path / "made", options)


def test_a_video_is_named_by_its_path_or_its_file_unless_that_is_of_several():
    sources = ["left/a.mp4", "right/a.mp4", "b.mp4"]
    assert find_videos(sources, ["right/a.mp4", "b"]) == [1, 2]
    with pytest.raises(ValueError, match=r"--holdout-camera a may be left/a\.mp4 or right/a\.mp4: give its path"):
        find_videos(sources, ["a"])


def test_the_last_path_of_the_command_is_the_capture(tmp_path, capsys):
    paths = [str(tmp_path / name) for name in ("a.mp4", "b.mp4", "capture")]
    assert main(["prepare", *paths]) == 2
    assert f"{Path(paths[0])} is missing: expected a video" in capsys.readouterr().err
