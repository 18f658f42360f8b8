"""The example programs run as a user starts them, on tiny sizes."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def run(name: str, *arguments: object) -> str:
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def size_of(path: Path) -> tuple[int, ...]:
    """(height, width) of an image file."""
    return cv2.imread(str(path)).shape[:2]


@pytest.mark.parametrize("name", NAMES)
def test_every_example_has_a_help_text(name):
    assert "--out" in run(name, "--help")


def test_fit_image_improves_the_psnr_by_more_than_12_decibels_in_60_steps(tmp_path):
    printed = run("fit_image", "--width", 48, "--gaussians", 400, "--steps", 60, "--out", tmp_path)
    before, after = (float(value) for value in re.findall(r"([\d.]+) dB", printed))
    assert after > before + 12
    assert size_of(tmp_path / "before.png") == size_of(tmp_path / "after.png") == (48, 48)


def test_fit_image_reads_the_image_that_it_is_given(tmp_path):
    grey = cv2.imread(str(EXAMPLES.parent / "docs" / "pictures" / "page.jpg"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "grey.png"), grey[:90, :180])
    run("fit_image", tmp_path / "grey.png", "--width", 32, "--gaussians", 20, "--steps", 1, "--out", tmp_path)
    assert size_of(tmp_path / "after.png") == (16, 32)


def test_train_from_python_leaves_a_run_with_metrics(finished_run, tmp_path):
    data = finished_run.parent / "capture"
    run("train_from_python", "--data", data, "--iterations", 6, "--out", tmp_path / "run")
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_render_a_time_writes_an_image_that_changes_with_time(finished_run, tmp_path):
    images = []
    for time in (0.0, 1.0):
        out = tmp_path / f"{time}.png"
        run("render_a_time", finished_run, "--time", time, "--view", 2, "--out", out)
        images.append(cv2.imread(str(out)))
    assert images[0].shape == (24, 32, 3)
    assert (images[0] != images[1]).any()
