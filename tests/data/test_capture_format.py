"""docs/capture-format.md: its example is a capture, and its tables name what the reader takes."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests import tiny
from warpgs.captures.check import check_capture
from warpgs.captures.opening import load_capture
from warpgs.data import camera_files, writer
from warpgs.data.lens import Lens

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "capture-format.md").read_text()


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example") / "example"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["write_a_capture.py", "--out", str(folder)])
        runpy.run_path(str(ROOT / "examples" / "write_a_capture.py"), run_name="__main__")
    return folder


def test_the_example_is_fit_to_train_on(example):
    report = check_capture(example)
    assert report.is_fit
    assert [f.text for f in report.findings if f.level == "warning"] == []


def test_the_example_is_trained_on(example, tmp_path):
    with tiny.in_haste():
        assert tiny.train(tiny.trainer(example, tmp_path / "run"))


def test_the_example_has_the_conventions_of_the_text(example):
    capture = load_capture(example)
    frame = capture.frame("frame_003")
    camera = frame.camera
    assert camera.time == pytest.approx(3 / 11)
    row, column, depth, inside = camera.project(capture.points)
    assert torch.allclose(depth[:500], torch.tensor(5.0 * 0.3))
    seen = inside & frame.static_mask[row, column]
    assert seen.sum() > 200
    assert (depth * frame.inverse_depth[row, column])[seen].median() == pytest.approx(0.3)
    assert not frame.static_mask[25, 35]
    x = -1.0 + 2.0 * 3 / 11
    assert np.allclose(camera.position.numpy(), (np.array([x, 0, 0]) - [0, 0, 2.5]) * 0.3, atol=1e-6)


def test_every_field_of_a_camera_is_in_the_text(tmp_path):
    writer.write_camera(tmp_path, "a", Lens(4, 3, (5.0, 5.0), (2.0, 1.5)), np.eye(3), np.zeros(3))
    written = re.findall(r'"(\w+)":', (tmp_path / "camera/a.json").read_text())
    read = re.findall(r'fields, "(\w+)"', Path(camera_files.__file__).read_text())
    documented = set(re.findall(r"`(\w+)`", TEXT))
    assert len(written) == 9
    assert {*written, *read} <= documented
