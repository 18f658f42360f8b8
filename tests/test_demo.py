"""The demo: its commands can be given as shown, it continues where it was, and ends with the first that fails."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from warpgs import demo
from warpgs.cli import COMMANDS, main
from warpgs.command_line.parsing import parse
from warpgs.prepare.frames import sample
from warpgs.training import command as training


@pytest.fixture
def given(monkeypatch):
    """The arguments of the commands that it ran; ``failing`` is one of which the exit code is 3."""
    given = SimpleNamespace(commands=[], failing=None, traced=[])

    def run(arguments):
        given.commands.append(arguments[3:])
        return 3 if arguments[3] == given.failing else 0

    def trace(path, log):
        given.traced.append(path)
        path.write_bytes(b"")

    monkeypatch.setattr(demo, "_run", run)
    monkeypatch.setattr(sample, "write_sample", trace)
    return given


def test_its_commands_are_those_of_a_user(given, tmp_path, capsys):
    assert main(["demo", str(tmp_path / "a/b")]) == 0
    assert [name for name, *_ in given.commands] == ["prepare", "train", "export"]
    shown = capsys.readouterr().out
    for name, *arguments in given.commands:
        assert f"$ warpgs {name} {' '.join(arguments)}" in shown
        options = COMMANDS[name].load()
        parsed = training.parse(arguments) if name == "train" else parse(options, arguments, name)
        assert isinstance(parsed, options)
    assert str(tmp_path / "a/b/run/export/scene.html") in shown
    assert given.traced == [tmp_path / "a/b/video.mp4"]


def test_it_traces_no_second_video_and_resumes_its_training(given, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.json").touch()
    (tmp_path / "video.mp4").touch()
    assert main(["demo", str(tmp_path)]) == 0
    assert given.traced == []
    assert given.commands[1] == ["train", "--resume", str(tmp_path / "run")]


def test_it_ends_with_the_first_command_that_fails(given, tmp_path):
    given.failing = "train"
    assert main(["demo", str(tmp_path)]) == 3
    assert [name for name, *_ in given.commands] == ["prepare", "train"]


def test_a_command_starts_in_a_process_of_its_own(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(sample, "write_sample", lambda path, log: Path(path).write_bytes(b"no video"))
    assert main(["demo", str(tmp_path)]) == 2
    assert "warpgs prepare: " in capfd.readouterr().err


WAITS = """
import signal, subprocess, sys
from warpgs import demo

class Told(subprocess.Popen):
    def wait(self, timeout=None):
        print("waits", flush=True)
        return super().wait(timeout)

subprocess.Popen = Told
signal.signal(signal.SIGINT, signal.default_int_handler)  # which shells turn off for what runs in the background
sys.exit(demo._run([sys.executable, "-c", sys.argv[1]]))
"""

ENDS_WHEN_TOLD = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    print("works", flush=True)
    while True:
        time.sleep(0.01)
except KeyboardInterrupt:
    print("saves", flush=True)
    sys.stdin.readline()
    print("saved", flush=True)
    sys.exit(130)
"""


def test_an_interrupted_command_may_end_by_itself():
    """Ctrl-C reaches both processes."""
    command = [sys.executable, "-c", WAITS, ENDS_WHEN_TOLD]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes, start_new_session=True) as process:
        assert {process.stdout.readline(), process.stdout.readline()} == {"waits\n", "works\n"}
        os.killpg(process.pid, signal.SIGINT)
        assert {process.stdout.readline(), process.stdout.readline()} == {"waits\n", "saves\n"}
        assert process.communicate("\n")[0].startswith("saved\n")
    assert process.returncode == 130
