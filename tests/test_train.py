"""python train.py, as a user starts it."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2

TRAIN = [sys.executable, str(Path(__file__).parent.parent / "train.py"), "--device", "cpu"]


def test_the_built_in_scene_is_rendered_and_said_to_be_all_there_is(tmp_path):
    run = subprocess.run([*TRAIN, "--frames", "1", "--out", str(tmp_path)], capture_output=True, text=True, check=True)
    sheet = cv2.imread(str(tmp_path / "000.png"))
    assert "trainer does not exist yet" in run.stdout
    assert sheet.shape == (540, 960, 3)
    assert sheet[:270].std() > 20  # the joint and the static image show something
    assert abs(sheet[:270, :480].astype(int) - sheet[:270, 480:]).max() > 50  # and the ring is in one only


def test_a_wrong_value_is_one_line_and_exit_code_2(tmp_path):
    run = subprocess.run([*TRAIN, "--frames", "0", "--out", str(tmp_path)], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert "--frames must be at least 1, got 0" in run.stderr
    assert "Traceback" not in run.stderr


def test_an_unknown_option_is_an_error(tmp_path):
    run = subprocess.run([*TRAIN, "--bogus", "1"], capture_output=True, text=True, check=False)
    assert run.returncode == 2


def test_ctrl_c_stops_without_a_traceback(tmp_path):
    # A job in the background ignores SIGINT and so would what it starts: the handler is put back as a terminal has it.
    program = (
        "import runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    command = [TRAIN[0], "-c", program, *TRAIN[1:], "--frames", "100000", "--out", str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        while not (tmp_path / "001.png").exists():
            assert run.poll() is None
            time.sleep(0.05)
        run.send_signal(signal.SIGINT)
        try:
            _, stderr = run.communicate(timeout=60)
        finally:
            run.kill()
    assert run.returncode == 130
    assert "Traceback" not in stderr
