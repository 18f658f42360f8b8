"""Training a small built-in scene on the CPU reaches the expected image quality."""

import json
import subprocess
import sys
from pathlib import Path

from warpgs.synthetic.room import BuiltinScene, builtin_capture

SCRIPT = str(Path(__file__).parent.parent / "train.py")
SCENE = BuiltinScene(width=120, height=68, num_frames=30, num_samples=4, num_points=2000)


def test_held_out_views_both_regions_and_changes_with_time_are_learned(tmp_path):
    data, run = builtin_capture(tmp_path / "cache", SCENE, quiet=True), tmp_path / "run"
    options = ["--data", str(data), "--preset", "quick", "--device", "cpu", "--iterations", "500", "--out", str(run)]
    subprocess.run([sys.executable, SCRIPT, *options], check=True, capture_output=True)
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["psnr"] > 21.0
    assert metrics["psnr_static"] > 22.0
    assert metrics["psnr_dynamic"] > 16.5
    assert metrics["flicker"] > 1e-3  # shadows move; without the appearance network it is 2e-4
