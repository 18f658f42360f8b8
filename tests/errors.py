"""Errors of commands."""

from warpgs.cli import main


def error_line(capsys, *arguments):
    """The only line that a failing command prints."""
    assert main([*map(str, arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err
