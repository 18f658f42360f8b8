"""``warpgs prepare`` on the command line."""

import signal
import subprocess
import sys

from tests.prepare import boards
from warpgs.cli import main


def test_a_wrong_source_ends_with_exit_code_2_and_one_line(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("not a video")
    assert main(["prepare", str(tmp_path / "notes.txt"), str(tmp_path / "captures" / "capture")]) == 2
    assert not (tmp_path / "captures").exists()
    written = capsys.readouterr()
    assert written.err.startswith("warpgs prepare: ")
    assert written.err.count("\n") == 1
    assert "is not a video" in written.err


def test_after_an_interrupt_the_message_says_how_to_continue(tmp_path, capsys, monkeypatch):
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    shots = boards.write_folder(tmp_path / "shots", boards.record(10)[0])
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", interrupted)
    assert main(["prepare", str(shots), str(tmp_path / "capture")]) == 130
    assert "run the same command again to continue" in capsys.readouterr().err


def test_sigterm_ends_with_one_line_while_colmap_runs(tmp_path):
    shots = boards.write_folder(tmp_path / "shots", boards.record(24)[0])
    command = [sys.executable, "-m", "warpgs", "prepare", str(shots), str(tmp_path / "made")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().startswith("frames: 24")
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == "warpgs prepare: interrupted; run the same command again to continue\n"


def test_only_existing_contact_sheets_are_mentioned(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", boards.true_cameras)
    shots = boards.write_folder(tmp_path / "shots", boards.record(6)[0])
    arguments = ["prepare", str(shots), str(tmp_path / "made"), "--masks", "none", "--depth", "none"]
    assert main(arguments) == 0
    assert "look at masks.png in it" in capsys.readouterr().out
    assert main(arguments) == 0
    assert "was finished before; --force makes it again" in capsys.readouterr().out
