"""Training a small built-in scene on the CPU reaches the expected image quality."""

import json
import os
import subprocess
import sys
from pathlib import Path

from warpgs.synthetic.room import BuiltinScene, builtin_capture

SCRIPT = str(Path(__file__).parent.parent / "train.py")
SCENE = BuiltinScene(width=96, height=54, num_frames=24, num_samples=4, num_points=2000)


def test_held_out_views_both_regions_and_changes_with_time_are_learned(tmp_path):
    data, run = builtin_capture(tmp_path / "cache", SCENE, quiet=True), tmp_path / "run"
    options = ["--data", str(data), "--preset", "quick", "--device", "cpu", "--iterations", "300", "--out", str(run)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # the other core runs other tests
    subprocess.run([sys.executable, SCRIPT, *options], check=True, capture_output=True, env=environment)
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["psnr"] > 23.0
    assert metrics["psnr_static"] > 24.0
    assert metrics["psnr_dynamic"] > 19.0
    assert metrics["flicker"] > 1e-3  # shadows move; without the appearance network it is 3e-4
