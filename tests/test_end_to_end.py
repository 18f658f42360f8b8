"""Training a small built-in scene on the CPU reaches the expected image quality."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from warpgs.data.synthetic import BuiltinScene, builtin_capture

SCRIPT = str(Path(__file__).parent.parent / "train.py")
SCENE = BuiltinScene(width=120, height=68, num_frames=30, num_samples=4, num_points=2000)


@pytest.fixture(scope="module")
def metrics(tmp_path_factory):
    data = builtin_capture(tmp_path_factory.mktemp("cache"), SCENE, quiet=True)
    run = tmp_path_factory.mktemp("runs") / "run"
    options = ["--data", str(data), "--preset", "quick", "--device", "cpu", "--iterations", "500", "--out", str(run)]
    subprocess.run([sys.executable, SCRIPT, *options], check=True, capture_output=True)
    return json.loads((run / "metrics.json").read_text())


def test_held_out_views_reach_21_db(metrics):
    assert metrics["psnr"] > 21.0


def test_both_regions_are_learned(metrics):
    assert metrics["psnr_static"] > 22.0
    assert metrics["psnr_dynamic"] > 16.5


def test_the_static_region_changes_with_time(metrics):
    """Shadows move; without the appearance network flicker is 2e-4."""
    assert metrics["flicker"] > 1e-3
