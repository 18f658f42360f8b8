"""What the check finds in captures that are fit and in captures that are not."""

import json
import shutil
import time

import cv2
import numpy as np
import pytest

from tests.data import captures
from tests.data.captures import edit_json, write_array
from tests.prepare import filmed
from warpgs.data.nerfies import load_capture
from warpgs.prepare.check import check_capture, quick_findings


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    root = filmed.write_capture(tmp_path_factory.mktemp("check") / "film")
    shutil.rmtree(root / "frames")
    return root


@pytest.fixture
def root(film, tmp_path):
    return shutil.copytree(film, tmp_path / "film")


def texts(report, level):
    return " | ".join(f.text for f in report.findings if f.level == level)


def test_a_good_capture_is_fit_without_warnings(root):
    report = check_capture(root)
    assert report.is_fit
    assert texts(report, "warning") == texts(report, "error") == ""
    assert "16 frames to train on, 0 to evaluate, 256×192" in texts(report, "note")
    assert str(report).endswith("fit to train on")


@pytest.mark.parametrize("kind", ["nerfds", "hypernerf", "iphone"])
def test_every_layout_is_read(tmp_path, kind):
    report = check_capture(captures.write_capture(tmp_path / "toy", kind))
    assert f"read as {kind}" in texts(report, "note")


def test_masks_that_are_turned_around_are_an_error(root):
    for path in (root / "resized_mask/1x").iterdir():
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    report = check_capture(root)
    assert not report.is_fit
    assert "turned around" in texts(report, "error")


def test_masks_where_everything_moves_are_an_error(root):
    for path in (root / "resized_mask/1x").iterdir():
        cv2.imwrite(str(path), np.zeros((192, 256), np.uint8))
    assert "everything moves" in texts(check_capture(root), "error")


def test_a_capture_without_masks_is_warned_of(root):
    shutil.rmtree(root / "resized_mask")
    assert "no masks" in texts(check_capture(root, "nerfds"), "warning")


def test_every_file_problem_is_named(root):
    for name in ("shot003", "shot007"):
        path = root / f"rgb/1x/{name}.png"
        path.write_bytes(path.read_bytes()[:900])
    report = check_capture(root)
    assert not report.is_fit
    assert "shot003.png" in texts(report, "error")
    assert "shot007.png" in texts(report, "error")


def test_what_is_no_capture_is_not_fit(tmp_path):
    report = check_capture(tmp_path)
    assert not report.is_fit
    assert "dataset.json is missing" in texts(report, "error")


def test_cameras_of_other_pictures_are_warned_of(root):
    names = sorted(p.name for p in (root / "camera").iterdir())
    shuffled = np.random.default_rng(0).permutation(len(names))
    facts = [(root / "camera" / name).read_text() for name in names]
    for name, k in zip(names, shuffled, strict=True):
        (root / "camera" / name).write_text(facts[k])
    assert "cameras may not belong" in texts(check_capture(root), "warning")


def test_cameras_that_look_away_are_an_error(root):
    for path in (root / "camera").iterdir():
        rotation = np.array(json.loads(path.read_text())["orientation"])
        edit_json(path, orientation=(np.diag([-1.0, 1.0, -1.0]) @ rotation).tolist())
    assert "do not see the points" in texts(check_capture(root), "error")


def test_points_at_the_cameras_are_warned_of(root):
    centers = [json.loads(p.read_text())["position"] for p in (root / "camera").iterdir()]
    points = np.load(root / "points.npy")
    write_array(root / "points.npy", np.vstack([points, centers, centers]))
    assert "no surfaces" in texts(check_capture(root), "warning")


def test_depth_that_grows_with_distance_is_warned_of(root):
    for k in range(16):
        x, y = np.meshgrid(np.arange(256.0), np.arange(192.0))
        noise = np.random.default_rng(k).uniform(0, 1, x.shape)
        write_array(root / f"depth/1x/shot{k:03d}.npy", (noise + 0 * y).astype(np.float32))
    text = texts(check_capture(root), "warning")
    assert "can't be aligned" in text or "off at the points" in text


def test_one_time_for_all_frames_is_an_error(root):
    names = json.loads((root / "metadata.json").read_text())
    (root / "metadata.json").write_text(json.dumps({n: {"time_id": 0} for n in names}))
    assert "one time" in texts(check_capture(root), "error")


def test_the_report_is_plain_json(root):
    plain = json.loads(json.dumps(check_capture(root).plain()))
    assert plain["fit"] is True
    assert {f["level"] for f in plain["findings"]} == {"note"}


def test_the_quick_check_is_quick_and_silent_about_a_good_capture(root):
    capture = load_capture(root)
    start = time.process_time()
    assert quick_findings(capture) == []
    assert time.process_time() - start < 1.0


def test_the_quick_check_leaves_damaged_frames_to_be_told_as_such(root):
    path = root / "rgb/1x/shot000.png"
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(ValueError, match=r"shot000\.png"):
        quick_findings(load_capture(root))


def test_the_quick_check_finds_cameras_that_look_away(root):
    for path in (root / "camera").iterdir():
        rotation = np.array(json.loads(path.read_text())["orientation"])
        edit_json(path, orientation=(np.diag([-1.0, 1.0, -1.0]) @ rotation).tolist())
    assert [f.level for f in quick_findings(load_capture(root))] == ["error"]
