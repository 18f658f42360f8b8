"""Errors of commands end with one line and an exit code."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from warpgs.captures.findings import Finding
from warpgs.errors import (
    ADVICE,
    CLOSED,
    command,
    counted,
    is_out_of_memory,
    missing,
    not_one_of,
    one_line,
    run_command,
    suggestion,
    terminable,
)


def failing(error):
    def command():
        raise error

    return command


def test_a_pipe_that_breaks_elsewhere_is_an_error_like_others(capsys):
    assert run_command(failing(BrokenPipeError(32, "Broken pipe"))) == 2
    assert capsys.readouterr().err == "warpgs: [Errno 32] Broken pipe\n"


@pytest.mark.parametrize(("returned", "code"), [(None, 0), (0, 0), (1, 1), (130, 130), ("text", 0), (True, 0)])
def test_a_command_that_succeeds_decides_its_exit_code(returned, code, capsys):
    assert run_command(lambda: returned) == code
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("error", [ValueError, ImportError, OSError, FileNotFoundError])
def test_errors_of_the_user_are_one_line_and_exit_code_2(error, capsys):
    assert run_command(failing(error("a file\n  is missing"))) == 2
    assert capsys.readouterr().err == "warpgs: a file is missing\n"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[31m.png is missing", r"a\x1b[31m.png is missing"),
        ("a\x07b\x9bc", r"a\x07b\x9bc"),
        ("gnp\u202e.a", r"gnp\u202e.a"),
        ("\udcff.png", r"\udcff.png"),
        ("Tür 日本.png", "Tür 日本.png"),
    ],
)
def test_what_a_terminal_would_obey_is_escaped(capsys, text, shown):
    run_command(failing(ValueError(text)))
    assert capsys.readouterr().err == f"warpgs: {shown}\n"
    assert str(Finding("error", "files", text)) == f"error: {shown}"


def test_ctrl_c_is_one_line_and_exit_code_130(capsys):
    assert run_command(failing(KeyboardInterrupt()), prog="train.py") == 130
    assert capsys.readouterr().err == "train.py: stopped\n"


def test_a_second_sigterm_does_not_interrupt_the_end_that_the_first_one_began():
    before = signal.getsignal(signal.SIGTERM)
    ended = False
    with terminable():
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            signal.raise_signal(signal.SIGTERM)
            ended = True
    assert ended
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory.\nTried 2 GiB"),
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes"),
    ],
)
def test_lack_of_memory_is_one_line_with_advice_and_exit_code_2(error, capsys):
    assert run_command(failing(error), advice="use less") == 2
    line = capsys.readouterr().err
    assert line.startswith("warpgs: out of memory (")
    assert line.endswith("; use less\n")
    assert line.count("\n") == 1


def test_lack_of_memory_has_advice_by_default(capsys):
    run_command(failing(MemoryError()))
    assert capsys.readouterr().err.endswith(f"; {ADVICE}\n")


@pytest.mark.parametrize("error", [RuntimeError("shapes differ"), AssertionError(), KeyError("x")])
def test_bugs_are_raised(error):
    with pytest.raises(type(error)):
        run_command(failing(error))


def test_an_exit_of_the_command_is_kept():
    with pytest.raises(SystemExit) as stop:
        run_command(failing(SystemExit(1)))
    assert stop.value.code == 1


def test_real_allocation_failures_are_recognized():
    for allocate in (lambda: torch.empty(1 << 60, dtype=torch.uint8), lambda: np.empty(1 << 60, np.uint8)):
        with pytest.raises((RuntimeError, MemoryError)) as caught:
            allocate()
        assert is_out_of_memory(caught.value)


OUT_OF_MEMORY = [
    "CUDA error: out of memory\nCUDA kernel errors might be asynchronously reported at some other API call",
    "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
    "DefaultCPUAllocator: not enough memory: you tried to allocate 4096 bytes.",
    "Failed to allocate 4096 bytes on device 'cuda:0'",
    "OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 4096 bytes in function 'f'",
]
OTHERS = [
    "shapes differ",
    "Negative strides are not supported for newly allocated arrays.",
    "Failed to allocate 4096 bytes on device 'cuda:0':  Failed to allocate memory during graph capture because "
    "memory pools are not enabled on device 'cuda:0'.",
    "CUDA error: operation not permitted when stream is capturing",
    "cannot allocate gradients of an integer tensor",
]


@pytest.mark.parametrize("message", OUT_OF_MEMORY + OTHERS)
def test_messages_of_lack_of_memory_are_recognized(message):
    assert is_out_of_memory(RuntimeError(message)) == (message in OUT_OF_MEMORY)


def test_a_command_in_a_message_can_be_pasted():
    assert command("prepare", Path("my video.mp4"), "--holdout", 8) == "warpgs prepare 'my video.mp4' --holdout 8"


def test_a_suggestion_is_written_as_it_is_known_whatever_the_case():
    assert suggestion("openvc", ["OPENCV", "SIMPLE"]) == "; did you mean OPENCV?"
    assert suggestion("OPENVC", ["opencv"]) == "; did you mean opencv?"
    assert suggestion("blender", ["opencv"]) == ""


def test_of_names_that_are_as_similar_the_first_is_suggested():
    frames = [f"right_{k:06}" for k in (50, 10, 0, 1)]
    assert suggestion("right_00000", frames) == "; did you mean right_000000?"
    assert suggestion("right_00005", frames) == "; did you mean right_000050?"


def test_a_missing_path_is_told_a_similar_one_that_exists(tmp_path, monkeypatch):
    (tmp_path / "hand").mkdir()
    assert missing(tmp_path / "hnd") == f"{tmp_path / 'hnd'} does not exist; did you mean {tmp_path / 'hand'}?"
    (tmp_path / "hand/depth").mkdir()
    assert missing(tmp_path / "hnd/depth").endswith(f"; did you mean {tmp_path / 'hand/depth'}?")
    (tmp_path / "loose").symlink_to(tmp_path / "gone")
    monkeypatch.setattr("os.listdir", Mock(side_effect=PermissionError))
    assert missing(tmp_path / "hnd") == f"{tmp_path / 'hnd'} does not exist"
    monkeypatch.undo()
    for path in (tmp_path / "studio", tmp_path / "nowhere/hand", tmp_path / "hnd/rgb", tmp_path / "loose"):
        assert missing(path) == f"{path} does not exist"


def test_one_line_has_no_line_breaks():
    assert one_line(ValueError("a\n\n  b\tc ")) == "a b c"


def test_a_very_long_message_is_shortened_in_its_middle():
    assert one_line(ValueError("a" * 4000)) == "a" * 4000
    assert one_line(ValueError("a" * 9000 + "b" * 9000)) == "a" * 2000 + " … " + "b" * 2000


def test_something_unknown_of_any_length_is_compared_at_once():
    start = time.process_time()
    message = not_one_of("preset", "quick" + "x" * 2_000_000, ["quick", "best" * 500_000])
    assert time.process_time() - start < 2.0
    assert "got 'quickxxxxxxx...xxxxxxxxxxxxx'" in message


def test_importing_errors_imports_no_torch():
    """Otherwise ``warpgs --help`` would be slow."""
    code = "import warpgs.errors, sys; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("arguments", "unbuffered"),
    [
        (["--help"], ""),
        (["--help"], "1"),
        (["train", "--help"], ""),
        (["train", "--help-all"], ""),
        (["train", "--help-all"], "1"),
        (["--tyro-print-completion", "bash"], ""),
    ],
)
def test_output_that_nobody_reads_is_no_error(arguments, unbuffered):
    """This is what ``warpgs --help | head`` does."""
    reader, writer = os.pipe()
    os.close(reader)
    command, environment = [sys.executable, "-m", "warpgs", *arguments], {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, env=environment)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (CLOSED, b"")


@pytest.mark.parametrize(("number", "text"), [(0, "0 images"), (1, "1 image"), (2, "2 images"), (1200, "1,200 images")])
def test_one_thing_is_not_several(number, text):
    assert counted(number, "image") == text
