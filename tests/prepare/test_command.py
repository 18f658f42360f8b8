"""``warpgs prepare`` and ``warpgs check`` as they are called."""

import json

import pytest

from tests.prepare import filmed
from warpgs.cli import main
from warpgs.prepare.sfm import Cameras


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return filmed.write_capture(tmp_path_factory.mktemp("commands"))


def test_a_fit_capture_ends_with_exit_code_0(root, capsys):
    assert main(["check", str(root)]) == 0
    assert capsys.readouterr().out.strip().endswith("fit to train on")


def test_an_unfit_capture_ends_with_exit_code_1_and_json_if_asked(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["check", str(tmp_path), "--json"])
    assert stop.value.code == 1
    assert json.loads(capsys.readouterr().out)["fit"] is False


def test_a_wrong_source_ends_with_exit_code_2_and_one_line(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("no video")
    assert main(["prepare", str(tmp_path / "notes.txt"), str(tmp_path / "capture")]) == 2
    written = capsys.readouterr()
    assert written.err.startswith("warpgs: ")
    assert written.err.count("\n") == 1
    assert "is no video" in written.err


def test_an_interrupt_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    shots = filmed.write_folder(tmp_path / "shots", filmed.film(10)[0])

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", interrupted)
    with pytest.raises(SystemExit) as stop:
        main(["prepare", str(shots), str(tmp_path / "capture")])
    assert stop.value.code == 130
    assert "goes on from here" in capsys.readouterr().err


def test_only_the_contact_sheets_that_there_are_are_named(tmp_path, capsys, monkeypatch):
    def recover(folder, names, *rest):
        return Cameras(names, filmed.lens(), filmed.poses(len(names)), filmed.points(), 0.1, 10.0)

    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", recover)
    shots = filmed.write_folder(tmp_path / "shots", filmed.film(6)[0])
    assert main(["prepare", str(shots), str(tmp_path / "made"), "--masks", "none", "--depth", "none"]) == 0
    assert "look at masks.png in it" in capsys.readouterr().out
