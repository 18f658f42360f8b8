"""python train.py, as a user starts it."""

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.config import TrainConfig
from warpgs.data.loaders import load_capture
from warpgs.data.synthetic import BuiltinScene, builtin_capture
from warpgs.runs import checkpoint
from warpgs.runs import run as runs
from warpgs.training import train as script

SCRIPT = str(Path(__file__).parents[2] / "train.py")
SMALL = BuiltinScene(width=64, height=36, num_frames=6, num_samples=2, num_points=400)
QUICK = ["--preset", "quick", "--device", "cpu"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return builtin_capture(tmp_path_factory.mktemp("cache"), SMALL, quiet=True)


def train(*arguments):
    return subprocess.run([sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    return train("--data", data, *QUICK, "--iterations", 40, "--out", folder), folder


def test_a_run_ends_with_its_figures_for_people(finished):
    run, _ = finished
    assert run.returncode == 0, run.stderr
    assert "PSNR" in run.stdout
    assert "LPIPS not measured" in run.stdout


def test_a_run_that_is_being_trained_is_not_resumed_beside(finished):
    with runs.held(finished[1]):
        second = train("--resume", finished[1], "--device", "cpu")
    assert second.returncode == 2
    assert f"train.py: {finished[1]} is being trained by another process" in second.stderr
    with runs.held(finished[1]):
        pass  # free again


def test_a_run_leaves_its_metrics(finished):
    metrics = json.loads((finished[1] / "metrics.json").read_text())
    wanted = (
        "psnr ssim lpips psnr_static psnr_dynamic flicker fps train_seconds num_static num_dynamic iterations commit"
    )
    assert set(wanted.split()) <= set(metrics)
    assert metrics["iterations"] == 40
    assert metrics["lpips"] is None
    assert metrics["psnr"] > 10


def test_a_run_leaves_metrics_of_every_view(finished):
    with open(finished[1] / "views.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["right_000000", "right_000002", "right_000004"]
    assert rows[0]["lpips"] == ""
    assert float(rows[0]["psnr"]) > 10


def test_a_run_leaves_pictures_a_video_and_events(finished):
    folder = finished[1]
    sheet = cv2.imread(str(folder / "pictures/right_000002.png"))
    assert sheet.shape[1] == 5 * SMALL.width
    video = cv2.VideoCapture(str(folder / "time.mp4"))
    assert video.read()[0]
    assert list((folder / "events").glob("events*"))


def test_a_run_keeps_its_resolved_config(finished):
    config = json.loads((finished[1] / "config.json").read_text())
    schedule = config["schedule"]
    assert schedule["pretrain"] + schedule["stage1"] + schedule["stage2"] == 40
    assert config["device"] == "cpu"


def test_a_finished_run_can_be_evaluated_again(finished):
    folder = finished[1]
    before = (folder / "views.csv").read_text()
    program = "import sys; from warpgs.cli import main; sys.exit(main(sys.argv[1:]))"
    run = subprocess.run(
        [sys.executable, "-c", program, "eval", str(folder)], capture_output=True, text=True, check=True
    )
    assert "PSNR" in run.stdout
    assert (folder / "views.csv").read_text() == before


def refused(*arguments):
    run = train(*arguments)
    assert run.returncode == 2
    assert "Traceback" not in run.stderr + run.stdout
    return run.stderr + run.stdout


def test_a_folder_that_is_no_capture_is_one_line_and_exit_code_2(tmp_path):
    text = refused("--data", tmp_path, *QUICK)
    assert "dataset.json is missing" in text
    assert len([line for line in text.splitlines() if line.startswith("error:")]) == 1


def test_a_damaged_picture_is_one_line_that_names_it(tmp_path):
    data = builtin_capture(tmp_path, SMALL, quiet=True)
    path = data / "rgb/1x/left_000003.png"
    path.write_bytes(path.read_bytes()[:100])
    assert "left_000003.png" in refused("--data", data, *QUICK, "--iterations", 40, "--out", tmp_path / "run")


def look_away(data):
    """Turns every camera around its vertical axis: none sees the points any more."""
    for path in (data / "camera").iterdir():
        facts = json.loads(path.read_text())
        facts["orientation"] = (np.diag([-1.0, 1.0, -1.0]) @ np.array(facts["orientation"])).tolist()
        path.write_text(json.dumps(facts))


def test_training_in_vain_is_refused_with_one_line_and_exit_code_1(tmp_path):
    data = builtin_capture(tmp_path, SMALL, quiet=True)
    look_away(data)
    run = train("--data", data, *QUICK, "--iterations", 40, "--out", tmp_path / "run")
    assert run.returncode == 1
    assert [line for line in run.stderr.splitlines() if line.startswith("error:")] == [
        "error: the cameras do not see the points: orientation, position or scene.json's center and scale are wrong"
    ]
    assert "Traceback" not in run.stderr
    assert not (tmp_path / "run").exists()


def test_one_time_for_all_frames_is_only_warned_of_where_all_is_static(tmp_path, capsys):
    root = boards.write_capture(tmp_path / "film")
    names = json.loads((root / "metadata.json").read_text())
    (root / "metadata.json").write_text(json.dumps({name: {"time_id": 0} for name in names}))
    capture = load_capture(root)
    assert script.checked(capture, TrainConfig(assume="static")) is capture
    assert "warning: all training frames have one time" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        script.checked(capture, TrainConfig())
    assert stop.value.code == 1


def test_what_training_would_suffer_from_is_told_and_what_is_well_is_not(finished):
    run, _ = finished
    warnings = [line for line in run.stdout.splitlines() if line.startswith("warning:")]
    assert warnings == ["warning: 6 training frames are very few"]


def test_an_existing_run_is_not_overwritten(data, finished):
    assert "is not empty" in refused("--data", data, *QUICK, "--out", finished[1])


def test_an_unknown_option_is_an_error():
    assert "bogus" in refused("--bogus", 1)


def test_resuming_takes_no_other_options(finished):
    assert "leave out --seed" in refused("--resume", finished[1], "--seed", 3)


def test_resuming_what_is_no_run_is_one_line(tmp_path):
    assert "is no run folder" in refused("--resume", tmp_path)


def test_too_few_iterations_are_refused(data):
    assert "iterations must be a number of at least 3" in refused("--data", data, *QUICK, "--iterations", 1)


def test_ctrl_c_keeps_what_was_done_and_says_how_to_go_on(data, tmp_path):
    # A job in the background ignores SIGINT and so would what it starts: the handler is put back as a terminal has it.
    program = (
        "import runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    folder = tmp_path / "run"
    options = ["--data", str(data), *QUICK, "--iterations", "100000", "--out", str(folder)]
    with subprocess.Popen([sys.executable, "-c", program, SCRIPT, *options], stderr=subprocess.PIPE, text=True) as run:
        while not checkpoint.list_checkpoints(folder):
            assert run.poll() is None
            time.sleep(0.05)
        time.sleep(2.0)
        run.send_signal(signal.SIGINT)
        try:
            _, stderr = run.communicate(timeout=60)
        finally:
            run.kill()
    assert run.returncode == 130
    assert "Traceback" not in stderr
    assert f"--resume {folder}" in stderr
    facts = checkpoint.load(checkpoint.list_checkpoints(folder)[-1]).facts
    assert facts["iteration"] > 0
