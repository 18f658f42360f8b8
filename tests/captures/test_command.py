"""``warpgs check`` as it is called."""

import json
import subprocess
import sys
import zipfile

import pytest
import tyro

from tests.data import layouts
from tests.prepare import boards
from warpgs.captures.command import run_check
from warpgs.captures.options import Check

HEAVY = ("torch", "numpy", "cv2", "warp", "scipy")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return boards.write_capture(tmp_path_factory.mktemp("commands"))


def check(*arguments):
    run_check(tyro.cli(Check, args=[str(argument) for argument in arguments]))


def test_a_fit_capture_is_reported_without_an_exit(root, capsys):
    check(root)
    assert capsys.readouterr().out.strip().endswith("fit to train on")


def test_an_unfit_capture_exits_with_code_1_and_prints_json_on_request(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        check(tmp_path, "--json")
    assert stop.value.code == 1
    assert json.loads(capsys.readouterr().out)["fit"] is False


def test_json_is_all_that_is_printed_where_depth_is_damaged(tmp_path, capsys):
    """OpenEXR prints what it cannot decode."""
    root, path = layouts.write_vipe(tmp_path), tmp_path / "depth/clip.zip"
    with zipfile.ZipFile(path) as archive:
        files = {name: bytearray(archive.read(name)) for name in archive.namelist()}
    files["00000.exr"][-100:-50] = bytes(50)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, bytes(data))
    with pytest.raises(SystemExit):
        check(root, "--json")
    assert "damaged or truncated OpenEXR data" in str(json.loads(capsys.readouterr().out)["findings"])


def test_an_unknown_dataset_is_reported_with_the_known_ones(root, capsys):
    with pytest.raises(SystemExit) as stop:
        check(root, "--dataset", "blend")
    assert stop.value.code == 1
    out = capsys.readouterr().out
    assert "dataset must be one of iphone, nerfds, hypernerf, nerfstudio" in out
    assert "got 'blend'" in out


def test_the_dataset_and_factor_given_are_used(root, capsys):
    check(root, "--dataset", "hypernerf", "--factor", "2")
    assert "read as hypernerf" in capsys.readouterr().out


def test_importing_the_options_imports_no_heavy_package():
    """Otherwise ``warpgs --help`` would be slow."""
    code = f"import warpgs.captures.options, sys; print([name for name in {HEAVY} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
