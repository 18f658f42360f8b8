"""A cell on its node: a child process, its log, and what is reported."""

import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests import tiny
from warpgs.sweep import worker
from warpgs.sweep.worker import Job, run_job

HOST = socket.gethostname()


def job(folder, *arguments):
    running, log = str(folder / "running/cell"), str(folder / "logs/cell.log")
    return Job("cell", str(folder / "cell"), log, running, arguments, "cpu")


def replace_child(monkeypatch, program):
    """The child runs a program of Python instead of a training; sys.argv[2:] are its arguments."""
    popen = subprocess.Popen

    def start(command, **options):
        assert command[1:3] == ["-m", "warpgs.sweep.child"]
        return popen([sys.executable, "-c", program, *command[3:]], **options)

    monkeypatch.setattr(worker.subprocess, "Popen", start)


def test_a_broken_capture_is_one_line(tmp_path):
    capture = tiny.write(tmp_path)
    path = capture / "rgb/1x/left_000003.png"
    path.write_bytes(path.read_bytes()[:100])
    error = run_job(job(tmp_path, "--preset", "quick", "--data", str(capture), "--out", str(tmp_path / "cell")))
    assert error is not None
    assert error.startswith(f"{HOST}: warpgs train: {path} is truncated: ")
    assert "\n" not in error
    assert not (tmp_path / "running/cell").exists()
    assert not (tmp_path / "cell").exists()


def test_a_new_cell_gets_its_arguments_and_one_that_has_begun_is_resumed(tmp_path, monkeypatch):
    replace_child(monkeypatch, "import sys; print(sys.argv[2:])")
    assert run_job(job(tmp_path, "--seed", "3")) is None
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell/config.json").write_text("{}")
    assert run_job(job(tmp_path, "--seed", "3")._replace(evaluation=("--lpips", "w"))) is None
    lines = (tmp_path / "logs/cell.log").read_text().splitlines()
    assert lines[1] == "['train', '--seed', '3', '--device', 'cpu']"
    assert lines[3] == f"['train', '--resume', '{tmp_path}/cell', '--lpips', 'w', '--device', 'cpu']"


def test_a_cell_that_is_trained_is_evaluated(tmp_path, finished_run):
    cell = shutil.copytree(finished_run, tmp_path / "cell")
    assert run_job(job(tmp_path)._replace(evaluation=("--quiet",), is_trained=True)) is None
    assert json.loads((cell / "metrics.json").read_text())["psnr"] > 0
    log = (tmp_path / "logs/cell.log").read_text()
    assert log.startswith(f"{HOST}: warpgs eval {cell} --quiet --device cpu\n")


def test_a_cell_that_is_killed_says_by_what(tmp_path, monkeypatch):
    replace_child(monkeypatch, "import os; os.kill(os.getpid(), 9)")
    assert run_job(job(tmp_path)) == f"{HOST}: the training was killed by signal 9"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, to which every write fails")
@pytest.mark.parametrize("file", ["logs/cell.log", "running/cell.partial"])
def test_a_disk_that_is_full_names_the_host_and_the_file(tmp_path, monkeypatch, file):
    replace_child(monkeypatch, "")
    (tmp_path / file).parent.mkdir()
    (tmp_path / file).symlink_to("/dev/full")
    path = tmp_path / file.removesuffix(".partial")
    assert run_job(job(tmp_path)) == f"{HOST}: {path} could not be written: No space left on device"


def test_a_disk_too_full_for_the_reason_of_a_failure_names_the_host_and_the_log(tmp_path, monkeypatch):
    """A limit of the size of files stands for the disk."""
    replace_child(monkeypatch, f"print('progress', flush=True); print({1 << 20} * 'x')")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, hard))
    try:
        error = run_job(job(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert error == f"{HOST}: {tmp_path}/logs/cell.log could not be written: File too large"


def test_an_interrupt_is_passed_on_and_waited_for(tmp_path, monkeypatch):
    program = (
        "import signal, time, pathlib, sys\n"
        "def stop(*_): time.sleep(0.3); pathlib.Path('saved').write_text(''); sys.exit(130)\n"
        "signal.signal(signal.SIGINT, stop); pathlib.Path('started').write_text(''); time.sleep(60)"
    )
    replace_child(monkeypatch, program)
    monkeypatch.chdir(tmp_path)

    def interrupt():
        while not (tmp_path / "started").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        run_job(job(tmp_path))
    thread.join()
    assert (tmp_path / "saved").exists()


def test_a_worker_that_was_started_in_the_background_can_be_interrupted(tmp_path, monkeypatch):
    """Shells let a command before & ignore SIGINT, and so do all processes below it."""
    replace_child(monkeypatch, "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)")
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert run_job(job(tmp_path)) is None
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert "True" in (tmp_path / "logs/cell.log").read_text().splitlines()


def test_a_training_ends_with_its_worker(tmp_path):
    program = (
        "import os, subprocess, sys\n"
        "code = 'import os, sys, time; from warpgs.sweep import child; import warpgs.training.command as c;'\n"
        "code += 'c.main = lambda *_: (print(os.getpid(), flush=True), time.sleep(60));'\n"
        "code += 'child.main([\"train\"], int(sys.argv[1]))'\n"
        "p = subprocess.Popen([sys.executable, '-c', code, str(os.getpid())], stdout=subprocess.PIPE)\n"
        "print(p.stdout.readline().decode(), flush=True); os._exit(0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    pid = int(done.stdout)
    for _ in range(100):
        if not alive(pid):
            return
        time.sleep(0.05)
    pytest.fail("the training outlived its worker")


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().split()[2] != "Z"
    except FileNotFoundError:
        return False
