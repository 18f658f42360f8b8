"""Findings of the check in captures that are fit to train on and in captures that are not."""

import contextlib
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.data import captures, layouts
from tests.data.captures import edit_json, exchange_cameras, look_away, stop_time, write_array
from tests.prepare import boards
from warpgs.captures import opening
from warpgs.captures.check import check_capture, quick_findings
from warpgs.captures.depth_check import DEPTH_PROBLEMS
from warpgs.captures.frames_check import check_counts
from warpgs.captures.motion_check import motion_between, pairs_to_compare
from warpgs.captures.opening import load_capture
from warpgs.captures.points_check import check_points
from warpgs.data.depth_alignment import sample_points
from warpgs.data.dynamic_regions import unknown_depth
from warpgs.views.view_reader import ViewReader

WITHOUT_MOTION = pytest.mark.usefixtures("without_motion")


@pytest.fixture
def root(with_boards, tmp_path):
    return shutil.copytree(with_boards, tmp_path / "capture")


def texts(report, level):
    return " | ".join(f.text for f in report.findings if f.level == level)


def test_a_good_capture_is_fit_without_warnings_in_a_report_of_plain_json(root):
    report = check_capture(root)
    assert report.is_fit
    assert texts(report, "warning") == texts(report, "error") == ""
    assert "16 frames to train on, 0 to evaluate, 256×192" in texts(report, "note")
    assert str(report).endswith("fit to train on")
    plain = json.loads(json.dumps(report.plain()))
    assert plain["fit"] is True
    assert {finding["level"] for finding in plain["findings"]} == {"note"}


def test_a_single_training_frame_is_said_to_show_no_motion(root):
    capture = load_capture(root)
    warnings = [f.text for f in check_counts(capture.split(capture.train[:1], ())) if f.level == "warning"]
    assert warnings == ["1 training frame shows no motion: give frames of other moments"]
    still = capture.split(capture.train[:1], ()).assuming("static")
    assert [f.text for f in check_counts(still) if f.level == "warning"] == ["1 training frame is very few"]


@pytest.mark.parametrize(("dataset", "masks", "depth"), [("nerfds", 6, 0), ("hypernerf", 0, 0), ("iphone", 0, 4)])
def test_every_dataset_is_read_completely(tmp_path, dataset, masks, depth):
    notes = texts(check_capture(captures.write_capture(tmp_path / "toy", dataset)), "note")
    assert f"read as {dataset} | 4 frames to train on, 2 to evaluate" in notes
    assert f"{masks} of 6 frames have masks, {depth} have depth" in notes


def test_images_of_a_camera_that_only_turns_are_an_error_whatever_its_poses(root):
    for path, image in zip(sorted((root / "rgb/1x").iterdir()), boards.pan(16), strict=True):
        cv2.imwrite(str(path), image)
    report = check_capture(root)
    assert "the camera only turns: a rotation explains" in texts(report, "error")
    assert not report.is_fit


def test_a_camera_that_passes_a_wall_is_told_by_its_focal_length_from_one_that_turns(root):
    """With a longer focal length, a rotation would shift the image of the wall as the camera does."""
    wall = boards.texture(3, (150, 140, 120), 400, (40, 120))
    for k, path in enumerate(sorted((root / "rgb/1x").iterdir())):
        cv2.imwrite(str(path), wall[100:292, 8 * k : 8 * k + 256])
    report = check_capture(root)
    assert "with the best focal length" in texts(report, "warning")
    assert "only turns" not in texts(report, "error")


@pytest.mark.parametrize(
    ("convert", "text"),
    [(np.invert, "inverted"), (np.zeros_like, "everything as dynamic")],
    ids=["inverted", "dynamic"],
)
def test_inverted_and_entirely_dynamic_masks_are_an_error(root, convert, text):
    for path in (root / "resized_mask/1x").iterdir():
        cv2.imwrite(str(path), convert(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
    report = check_capture(root)
    assert not report.is_fit
    assert text in texts(report, "error")


def write_masks(root, is_cut):
    """A box that moves in every frame; the lower border cuts it off in these."""
    for k, path in enumerate(sorted((root / "resized_mask/1x").iterdir())):
        mask = np.full((192, 256), 255, np.uint8)
        mask[110 : 192 if is_cut(k) else 170, 90:140] = 0
        cv2.imwrite(str(path), mask)


@WITHOUT_MOTION
@pytest.mark.parametrize(("num_cut", "warned"), [(4, False), (5, True), (16, True)])
def test_unknown_depth_of_objects_that_the_border_cuts_off_in_too_many_frames_is_a_warning(root, num_cut, warned):
    write_masks(root, lambda k: k < num_cut)
    assert (unknown_depth(num_cut, 16) in texts(check_capture(root), "warning")) == warned


@WITHOUT_MOTION
@pytest.mark.parametrize("is_known", [False, True])
def test_objects_that_the_border_cuts_off_are_no_warning_if_their_depth_is_known(root, is_known):
    write_masks(root, lambda k: True)
    columns = np.arange(256)
    is_dynamic = (columns >= 90) & (columns < 140)
    write_depth(root, lambda depth: np.where(is_dynamic & (not is_known), np.nan, 1.0 / depth))
    assert (unknown_depth(16, 16) in texts(check_capture(root), "warning")) == (not is_known)


def test_what_does_not_exist_is_no_capture_to_report_on(tmp_path):
    with pytest.raises(ValueError, match="nowhere does not exist"):
        check_capture(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="there is no built-in capture builtin:nothing"):
        check_capture(Path("builtin:nothing"))


def test_a_built_in_capture_is_checked_by_its_name(root, monkeypatch):
    monkeypatch.setattr(opening, "builtin_folder", lambda *_: root)
    assert check_capture(Path("builtin:studio")).is_fit


def test_missing_masks_are_an_error_that_says_how_to_make_them(root):
    shutil.rmtree(root / "resized_mask")
    report = check_capture(root, "nerfds")
    assert not report.is_fit
    assert "no masks: make them with warpgs prepare CAPTURE --add masks" in texts(report, "error")
    assert "cameras" in {finding.topic for finding in report.findings}


@WITHOUT_MOTION
@pytest.mark.parametrize(
    ("masked", "text"),
    [
        ([0, 8], "9 of 11 training frames, such as frame_00001, have no masks: make them with"),
        ([4], "the training frames have no masks: make them with"),
        ([k for k in range(12) if k != 4], ""),
    ],
    ids=["two frames", "the evaluation frame", "the training frames"],
)
def test_training_frames_need_masks_and_evaluation_frames_do_not_as_in_training(tmp_path, masked, text):
    root = layouts.write_colmap(tmp_path / "scene")
    names = sorted((root / "masks").iterdir())
    for k in {*range(12)} - {*masked}:
        names[k].unlink()
    report = check_capture(root)
    assert report.is_fit == (text == "")
    assert texts(report, "error").startswith(text)
    assert f"{len(masked)} of 12 frames have masks" in texts(report, "note")
    views = ViewReader(load_capture(root), 0.0, pinned=False)
    refused = pytest.raises(ValueError, match="has no mask") if text else contextlib.nullcontext()
    with refused:
        for k in range(11):
            views.read(k)


@WITHOUT_MOTION
def test_every_damaged_file_is_named(root):
    for name in ("shot003", "shot007"):
        path = root / f"rgb/1x/{name}.png"
        path.write_bytes(path.read_bytes()[:900])
    report = check_capture(root)
    assert not report.is_fit
    assert "shot003.png" in texts(report, "error")
    assert "shot007.png" in texts(report, "error")
    assert " readable frames have masks" in texts(report, "note")


@pytest.mark.parametrize("damaged", ["rgb/1x/{}.png", "resized_mask/1x/{}.png.png"])
def test_a_damaged_evaluation_frame_is_an_error_that_names_it(root, damaged):
    ids = json.loads((root / "dataset.json").read_text())["train_ids"]
    held_out = ids.pop(7)
    edit_json(root / "dataset.json", train_ids=ids, val_ids=[held_out])
    path = root / damaged.format(held_out)
    path.write_bytes(path.read_bytes()[:-20])
    report = check_capture(root)
    assert not report.is_fit
    assert texts(report, "error") == f"{path} is truncated: its last chunk is cut off"
    assert texts(report, "warning") == ""
    assert "epipolar lines" in texts(report, "note")  # the training frames are checked as ever


def test_a_folder_that_is_not_a_capture_is_not_fit(tmp_path):
    report = check_capture(tmp_path)
    assert not report.is_fit
    assert "has no dataset.json" in texts(report, "error")


def test_cameras_that_do_not_match_the_images_are_a_warning(root):
    exchange_cameras(root)
    assert "cameras may not match" in texts(check_capture(root), "warning")


def test_cameras_that_look_away_are_an_error_also_of_the_quick_check(root):
    look_away(root)
    assert "do not see the points" in texts(check_capture(root), "error")
    assert [f.level for f in quick_findings(load_capture(root))] == ["error"]


@WITHOUT_MOTION
def test_points_at_the_cameras_are_a_warning(root):
    centers = [json.loads(p.read_text())["position"] for p in (root / "camera").iterdir()]
    points = np.load(root / "points.npy")
    write_array(root / "points.npy", np.vstack([points, centers, centers]))
    assert "not on surfaces" in texts(check_capture(root), "warning")


def test_a_camera_that_hardly_moves_for_how_far_it_looks_is_told_what_not_to_trust(root):
    capture = load_capture(root)
    center = torch.stack([capture.cameras[name].position for name in capture.train]).mean(0)

    def shrunk(camera, factor):
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] = -viewmat[:3, :3] @ (center + factor * (camera.position - center))
        return replace(camera, viewmat=viewmat)

    share = capture.path_radius / capture.median_depth
    for factor, told in ((0.009 / share, True), (0.02 / share, False)):
        closer = capture.with_cameras({name: shrunk(camera, factor) for name, camera in capture.cameras.items()})
        warnings = [f.text for f in check_points(closer, closer.train) if f.level == "warning"]
        text = "the camera hardly moves, by 0.9% of the depth at which it sees the scene: images do not determine depth"
        assert warnings == [f"{text}, so trust no render from another place"] * told


def write_depth(root, convert):
    for k, view in enumerate(boards.poses(16)):
        write_array(root / f"depth/1x/shot{k:03d}.npy", convert(boards.depth(view)).astype(np.float32))


def test_inverse_depth_of_any_scale_is_fit(root):
    write_depth(root, lambda depth: 30.0 / depth + 2.0)
    report = check_capture(root)
    assert texts(report, "warning") == ""
    assert "off at the points" in texts(report, "note")


def check_metric(root, convert):
    """Checks the capture with depth in files that DyCheck's layout takes for those of a sensor."""
    write_depth(root, convert)
    return check_capture(root, "iphone", factor=1)


@WITHOUT_MOTION
def test_metric_depth_is_compared_as_it_is(root):
    assert "metric depth is 0.0% off" in texts(check_metric(root, lambda depth: depth), "note")
    report = check_metric(root, lambda depth: 2.0 * depth)  # a scale would hide it
    assert "metric depth is 50.0% off" in texts(report, "note")
    assert "12 of 12 frames is hardly better than a constant: presets other than paper do not use it" in texts(
        report, "warning"
    )


@WITHOUT_MOTION
def test_metric_depth_without_points_to_compare_with_is_fit(root):
    report = check_metric(root, lambda depth: np.where(np.arange(256) == 5, depth, 0.0))  # 0 is unknown
    assert "cannot" not in str(report)
    assert "too few to align" not in str(report)


@WITHOUT_MOTION
def test_metric_depth_that_is_known_nowhere_is_a_warning(root):
    assert "is known nowhere" in texts(check_metric(root, np.zeros_like), "warning")


@WITHOUT_MOTION
def test_depth_instead_of_inverse_depth_is_a_warning(root):
    write_depth(root, lambda depth: depth)
    warnings = texts(check_capture(root), "warning")
    assert "the depth of 12 of 12 frames cannot be aligned to the points: it grows" in warnings


@WITHOUT_MOTION
@pytest.mark.parametrize(
    ("convert", "problem"),
    [
        (lambda depth: np.full_like(depth, np.nan), "is known nowhere"),
        (lambda depth: np.full_like(depth, 3.0), "is the same at all points"),
        (lambda depth: np.where(np.arange(256) < 2, depth, np.nan), "is known at fewer than 16 of the points"),
    ],
)
def test_problems_of_depth_are_told_apart(root, convert, problem):
    write_depth(root, convert)
    assert texts(check_capture(root), "warning") == f"the depth of 12 of 12 frames {problem}" + next(
        text.removeprefix(problem) for text in DEPTH_PROBLEMS.values() if text.startswith(problem)
    )


@WITHOUT_MOTION
def test_depth_that_is_known_nowhere_is_found_without_points(root):
    write_depth(root, lambda depth: np.full_like(depth, np.nan))
    (root / "points.npy").unlink()
    assert "is known nowhere" in texts(check_capture(root), "warning")


def test_flow_between_cameras_that_look_in_different_directions_is_no_evidence(root):
    """Every second camera looks to the right: its images are right, but show something else."""
    turn = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    noise = np.random.default_rng(0)
    for name in [f"shot{k:03d}" for k in range(1, 16, 2)]:
        rotation = np.array(json.loads((root / f"camera/{name}.json").read_text())["orientation"])
        edit_json(root / f"camera/{name}.json", orientation=(turn @ rotation).tolist())
        blurred = cv2.resize(noise.integers(0, 255, (48, 64, 3), np.uint8), (256, 192))
        captures.write_png(root / f"rgb/1x/{name}.png", blurred)
    report = check_capture(root)
    assert report.is_fit
    assert "may not match" not in str(report)
    assert "inverted" not in str(report)
    assert "from cameras too far apart" in texts(report, "note")


def test_pixels_whose_flow_does_not_lead_back_do_not_count(with_boards):
    capture = load_capture(with_boards)
    first, second = (capture.frame(name) for name in capture.train[:2])
    other = torch.from_numpy(captures.image_of("other", (256, 192)))
    assert motion_between(first, replace(second, image=other)) is None


def test_a_capture_in_which_everything_is_dynamic_is_fit(tmp_path):
    report = check_capture(layouts.write_blender(tmp_path / "scene"))
    assert report.is_fit
    assert "everything is taken as dynamic" in texts(report, "note")
    assert "read as blender" in texts(report, "note")


def test_of_a_built_in_capture_no_files_are_named(root):
    (root / "points.npy").unlink()
    capture = load_capture(root)
    capture.is_builtin = True
    findings = [*check_counts(capture), *check_points(capture, capture.train)]
    (points,) = (finding for finding in findings if finding.topic == "points")
    assert (points.level, points.text) == ("note", "there are no sparse points: Gaussians are randomly initialized")
    assert not [finding for finding in findings if "metadata.json" in finding.text]


def test_one_evaluation_frame_outside_of_the_training_frames_is_one(root):
    capture = load_capture(root)
    first, *rest = sorted(capture.train, key=lambda name: capture.cameras[name].time)
    capture.train, capture.val = tuple(rest), (first,)
    shown = [finding.text for finding in check_counts(capture)]
    assert "1 evaluation frame lies before or after all training frames" in shown


@WITHOUT_MOTION
def test_depth_that_must_be_aligned_is_said_to_be_unused_without_points(root):
    write_depth(root, lambda depth: 1.0 / depth)
    (root / "points.npy").unlink()
    report = check_capture(root)
    assert "there are no sparse points" in texts(report, "warning")
    assert "warpgs prepare CAPTURE --add points" in texts(report, "warning")
    unused = "the depth of 12 of 12 frames is not used, because it is aligned to sparse points and there are none"
    assert unused in texts(report, "warning")
    assert unused in [f.text for f in quick_findings(load_capture(root))]


@WITHOUT_MOTION
def test_one_time_for_all_frames_is_an_error(root):
    stop_time(root)
    assert "one time, but every moment needs its own (times from time_id in" in texts(check_capture(root), "error")
    assert "one time" in " ".join(f.text for f in quick_findings(load_capture(root)) if f.level == "error")


def test_one_time_for_all_frames_is_a_warning_if_everything_is_assumed_to_be_static(root):
    stop_time(root)
    findings = quick_findings(load_capture(root).assuming("static"))
    assert ["one time" in f.text for f in findings if f.topic == "time"] == [True]
    assert {f.level for f in findings} == {"warning"}


def test_images_too_small_for_optical_flow_are_checked_without_it(with_boards):
    """OpenCV crashes on images that are less than 16 pixels high."""
    capture = load_capture(with_boards)
    frames = [capture.frame(name) for name in capture.train[:2]]
    assert motion_between(*frames) is not None
    small = [replace(f, image=f.image[90:102], static_mask=f.static_mask[90:102]) for f in frames]
    assert motion_between(*small) is None


def test_the_quick_check_is_fast_and_finds_nothing_in_a_good_capture(root):
    capture = load_capture(root)
    start = time.process_time()
    assert quick_findings(capture) == []
    assert time.process_time() - start < 1.0
    assert quick_findings(capture.assuming("dynamic")) == []  # points are compared with the masks of the files


def test_the_quick_check_raises_on_damaged_frames(root):
    path = root / "rgb/1x/shot000.png"
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(ValueError, match=r"shot000\.png"):
        quick_findings(load_capture(root))


@WITHOUT_MOTION
def test_depth_that_is_no_nearer_to_the_points_than_a_constant_is_not_praised(root, monkeypatch):
    """Nearly all points have one depth, so that any depth can be aligned to them by a factor of 0."""
    write_depth(root, lambda depth: np.random.default_rng(0).uniform(0.1, 1.0, depth.shape))

    def one_depth(*arguments):
        found = sample_points(*arguments)
        position = torch.linspace(0.0, 1.0, len(found.depth))
        depth = torch.where(position < 0.06, 3.0, torch.where(position > 0.94, 5.0, 4.0))
        return found._replace(depth=depth.to(found.depth))

    monkeypatch.setattr("warpgs.captures.depth_check.sample_points", one_depth)
    said = "0.0% off at the points (median), but a constant is 0.0% off: the points do not tell whether depth is right"
    assert f"aligned depth is {said}" in texts(check_capture(root), "note")


def test_only_frames_of_one_camera_are_compared(root):
    capture = load_capture(root)
    cameras = {name: replace(c, id=k % 2) for k, (name, c) in enumerate(capture.cameras.items())}
    pairs = pairs_to_compare(capture.with_cameras(cameras), 100)
    assert len(pairs) == len(capture.train) - 2
    assert all(cameras[a].id == cameras[b].id for a, b in pairs)
