"""What the check and the start of training say of masks, and of captures that are assumed to have none."""

import json
import shutil

import cv2
import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, exchange_cameras, stop_time
from warpgs.captures import check
from warpgs.captures.check import check_capture, quick_findings
from warpgs.captures.findings import few_of
from warpgs.captures.opening import load_capture


@pytest.fixture
def root(with_boards, tmp_path):
    return shutil.copytree(with_boards, tmp_path / "capture")


def convert_masks(root, convert):
    for k, path in enumerate(sorted((root / "resized_mask/1x").iterdir())):
        cv2.imwrite(str(path), convert(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), k))


def of_masks(findings, level):
    return [finding.text for finding in findings if (finding.topic, finding.level) == ("masks", level)]


def instance_ids(mask, k):
    return np.where(mask == 0, 1 + k % 3, 0).astype(np.uint8)


@pytest.mark.parametrize(
    ("convert", "text"),
    [
        (lambda mask, k: np.where(mask == 0, 3, 0).astype(np.uint8), "everything as dynamic: 0 must mean dynamic"),
        (instance_ids, "% at most: 0 must mean dynamic and 255 static, and instance ids are not understood"),
        (lambda mask, k: np.invert(mask), "static regions of the masks move more than dynamic ones"),
    ],
    ids=["one instance", "instance ids", "inverted"],
)
def test_unusable_masks_are_an_error_in_the_same_words_before_training(root, convert, text):
    convert_masks(root, convert)
    errors = of_masks(check_capture(root).findings, "error")
    assert any(text in error for error in errors)
    assert of_masks(quick_findings(load_capture(root)), "error") == errors
    assert not of_masks(quick_findings(load_capture(root).assuming("dynamic")), "error")


def test_masks_that_mark_nothing_are_a_warning_in_the_same_words_before_training(root):
    convert_masks(root, lambda mask, k: np.full_like(mask, 255))
    warnings = of_masks(check_capture(root).findings, "warning")
    assert [text.split(":")[0] for text in warnings] == ["the masks mark nothing as dynamic"]
    assert of_masks(quick_findings(load_capture(root)), "warning") == warnings


def test_masks_are_judged_by_all_frames_if_those_that_are_compared_are_suspect(root, monkeypatch):
    """In every frame that training looks at first, everything moves; in the others, masks are right."""
    monkeypatch.setattr("warpgs.captures.check_sample.MAX_SAMPLES", 4)
    monkeypatch.setattr("warpgs.captures.check_sample.MIN_SAMPLES", 4)
    convert_masks(root, lambda mask, k: np.zeros_like(mask) if k in (0, 5, 10, 15) else mask)
    assert not of_masks(quick_findings(load_capture(root)), "error")


def test_estimated_masks_of_nearly_everything_are_a_warning_only(root):
    """Training tries them out."""
    convert_masks(root, lambda mask, k: np.where(np.arange(256) < 10, 255, 0).astype(np.uint8) + 0 * mask)
    assert any("on average" in text for text in of_masks(check_capture(root).findings, "error"))
    edit_json(root / "dataset.json", masks="estimated")
    findings = check_capture(root).findings
    assert not any("on average" in text for text in of_masks(findings, "error"))
    assert any("on average" in text for text in of_masks(findings, "warning"))


def test_masks_of_nearly_everything_are_a_warning_only_if_that_moves(root):
    marked = np.arange(256) >= 20
    convert_masks(root, lambda mask, k: np.where(marked, 0, 255).astype(np.uint8) + 0 * mask)
    assert any("92.2% of the pixels" in text for text in of_masks(check_capture(root).findings, "error"))
    for k, path in enumerate(sorted((root / "rgb/1x").iterdir())):
        image = cv2.imread(str(path))
        image[:, marked] = np.roll(image, 3 * k, axis=0)[:, marked]
        cv2.imwrite(str(path), image)
    findings = check_capture(root).findings
    assert not of_masks(findings, "error")
    assert any("92.2% of the pixels" in text for text in of_masks(findings, "warning"))
    assert not of_masks(quick_findings(load_capture(root)), "error")


def test_wrong_cameras_do_not_make_masks_inverted(root):
    """Far from their epipolar lines are all pixels then, and which ones more so is chance."""
    convert_masks(root, lambda mask, k: np.where(np.arange(256) < 100, 0, 255).astype(np.uint8) + 0 * mask)
    exchange_cameras(root)
    report = check_capture(root)
    assert "cameras may not match" in str(report)
    assert "inverted" not in str(report)


def test_masks_of_a_layout_in_which_white_is_dynamic_are_told_so(tmp_path):
    root = layouts.write_llff(tmp_path / "scene")
    for path in (root / "motion_masks").iterdir():
        cv2.imwrite(str(path), np.full((24, 40), 255, np.uint8))
    (error,) = of_masks(check_capture(root).findings, "error")
    assert "white must mean dynamic and black static" in error


def test_a_capture_without_masks_is_fit_under_the_assumption_that_training_is_given(root):
    shutil.rmtree(root / "resized_mask")
    assert not check_capture(root).is_fit
    report = check_capture(root, assume="static")
    assert report.is_fit
    assert "note: everything is taken as static" in str(report)


def test_a_capture_of_one_time_is_fit_if_everything_is_assumed_to_be_static(root):
    stop_time(root)
    assert not check_capture(root).is_fit
    assert check_capture(root, assume="static").is_fit


def test_as_many_frames_are_read_as_there_is_time_for(root, monkeypatch):
    ids = json.loads((root / "dataset.json").read_text())["train_ids"]
    edit_json(root / "dataset.json", train_ids=ids[:8], val_ids=ids[8:])
    monkeypatch.setattr(check, "READ_SECONDS", 0.0)
    report = check_capture(root)
    assert report.is_fit
    assert "8 of 16 frames were read" in str(report)
    assert "8 of 8 frames read have masks" in str(report)


def test_portrait_and_landscape_frames_that_alternate_fit_their_cameras(root):
    for k, path in enumerate(sorted((root / "camera").iterdir())):
        fields = json.loads(path.read_text())
        (x, y), (left, top) = fields["principal_point"], ((56, 0), (0, 24))[k % 2]
        size = [256 - 2 * left, 192 - 2 * top]
        edit_json(path, principal_point=[x - left, y - top], image_size=size)
        for part in (f"rgb/1x/{path.stem}.png", f"resized_mask/1x/{path.stem}.png.png"):
            pixels = cv2.imread(str(root / part), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(root / part), pixels[top : top + size[1], left : left + size[0]])
    report = check_capture(root)
    (text,) = (f.text for f in report.findings if "epipolar lines (median)" in f.text)
    assert float(text.split()[3]) < 0.5
    assert "may not match" not in str(report)


def cut_images(root, count):
    for path in sorted((root / "rgb/1x").iterdir())[:count]:
        path.write_bytes(path.read_bytes()[:100])


@pytest.mark.parametrize(
    ("count", "text"),
    [(1, "a"), (3, "a, b, c"), (4, "a, b, c, d"), (5, "a, b, c and 2 others"), (26, "a, b, c and 23 others")],
)
def test_a_finding_names_few_of_many_frames(count, text):
    assert few_of(list("abcdefghijklmnopqrstuvwxyz"[:count])) == text


def test_an_error_of_several_frames_is_one_line_with_their_files(root, monkeypatch):
    monkeypatch.setattr("warpgs.captures.findings.MAX_NAMED", 1)
    cut_images(root, 4)
    (text,) = [f.text for f in check_capture(root).findings if f.level == "error"]
    assert "shot000.png is truncated" in text
    assert text.endswith("(the same of 3 more files: shot001.png and 2 others)")


def test_an_error_of_all_frames_is_one_line_with_their_number(root):
    cut_images(root, 16)
    (text,) = [f.text for f in check_capture(root).findings if f.level == "error"]
    assert "shot000.png is truncated" in text
    assert text.endswith("(the same of all 16 frames)")


def test_frames_with_more_kinds_of_errors_than_are_shown_are_counted(root, monkeypatch):
    monkeypatch.setattr("warpgs.captures.frames_check.MAX_ERRORS", 1)
    cut_images(root, 3)
    (root / "rgb/1x/shot015.png").write_bytes(b"text")
    errors = [f.text for f in check_capture(root).findings if f.level == "error"]
    assert errors[1:] == ["1 more frames cannot be read"]


def test_masks_in_the_alpha_channel_alone_are_an_error_that_names_it(root):
    convert_masks(root, lambda mask, k: np.dstack([np.full((*mask.shape, 3), 255, np.uint8), 255 - mask]))
    (text,) = [f.text for f in check_capture(root).findings if f.level == "error"]
    assert "differs in its alpha channel only, which is not read" in text
    assert text.endswith("(the same of all 16 frames)")
