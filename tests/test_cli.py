"""The command itself."""

import importlib.metadata

from warpgs.cli import main


def test_it_says_its_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"warpgs {importlib.metadata.version('warpgs')}\n"
