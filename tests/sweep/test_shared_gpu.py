"""MPS is started for trainings that share a GPU, and ended; the driver's program is played by a script."""

import os
from pathlib import Path

import pytest
import torch

from warpgs.sweep import shared_gpu
from warpgs.sweep.options import Sweep
from warpgs.sweep.run_sweep import _shares_local_gpus
from warpgs.sweep.shared_gpu import CONTROL, PIPES, shared_gpus

SCRIPT = """#!/bin/sh
input=$(cat)
if [ "$input" = get_server_list ]; then
    {query}
fi
echo "$* $input $CUDA_MPS_PIPE_DIRECTORY ${{CUDA_VISIBLE_DEVICES-}}" >> {calls}
exit {code}
"""
NO_DAEMON = "echo Cannot find MPS control daemon process; exit"
"""What the driver's program does where MPS does not run, before its exit code."""


@pytest.fixture
def control(tmp_path, monkeypatch):
    """Puts a program with this exit code in the place of the driver's; ``control.calls`` says how it was called."""
    monkeypatch.delenv(PIPES, raising=False)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    def install(code, query=f"{NO_DAEMON} 1"):
        calls = tmp_path / "calls"
        (tmp_path / CONTROL).write_text(SCRIPT.format(calls=calls, code=code, query=query))
        (tmp_path / CONTROL).chmod(0o755)
        return lambda: [line.split() for line in calls.read_text().splitlines()] if calls.exists() else []

    return install


def test_processes_find_mps_which_has_all_gpus_until_it_is_ended(control, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    calls = control(0)
    with shared_gpus(pytest.fail):
        folder = os.environ[PIPES]
        assert Path(folder).is_dir()
        assert calls() == [["-d", folder]]
    assert calls() == [["-d", folder], ["quit", "-t", "5", folder, "1"]]
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "1"
    assert PIPES not in os.environ
    assert not Path(folder).exists()


def test_mps_is_ended_after_an_error_too(control):
    calls = control(0)
    with pytest.raises(KeyboardInterrupt), shared_gpus(pytest.fail):
        raise KeyboardInterrupt
    assert calls()[-1][0] == "quit"
    assert PIPES not in os.environ


def test_mps_that_does_not_end_is_said(control):
    control(0)
    lines = []
    with shared_gpus(lines.append):
        control(1)
    assert len(lines) == 1
    assert lines[0].startswith(f"{CONTROL} did not end: ")


def test_the_users_own_mps_is_used(control, monkeypatch):
    calls = control(0)
    monkeypatch.setenv(PIPES, "/somewhere")
    with shared_gpus(pytest.fail):
        assert os.environ[PIPES] == "/somewhere"
    assert os.environ[PIPES] == "/somewhere"
    assert calls() == []


def test_mps_in_its_default_folder_is_used(control):
    calls = control(0, query="echo 4711; exit 0")
    with shared_gpus(pytest.fail):
        assert PIPES not in os.environ
    assert calls() == []


@pytest.mark.parametrize("query", [f"{NO_DAEMON} 1", f"{NO_DAEMON} 0", "exit 1", "exec sleep 9"])
def test_mps_is_started_if_none_answers_in_its_default_folder(control, monkeypatch, query):
    monkeypatch.setattr(shared_gpu, "TIMEOUT", 3.0)
    calls = control(0, query)
    with shared_gpus(pytest.fail):
        assert calls() == [["-d", os.environ[PIPES]]]


def test_mps_that_does_not_start_is_said(control):
    control(3)
    lines = []
    with shared_gpus(lines.append):
        assert PIPES not in os.environ
    assert lines == [f"trainings take turns on a GPU, because {CONTROL} ended with exit code 3"]


def test_mps_that_is_not_installed_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(PIPES, raising=False)
    lines = []
    with shared_gpus(lines.append):
        assert PIPES not in os.environ
    assert lines == [f"trainings take turns on a GPU, because {CONTROL} is not installed"]


@pytest.mark.parametrize(
    ("options", "gpus", "shares"),
    [
        ({"per_gpu": 2}, 1, True),
        ({"per_gpu": 2}, 0, False),
        ({"per_gpu": 1}, 1, False),
        ({"per_gpu": 2, "device": "cpu"}, 1, False),
        ({"per_gpu": 2, "address": "head:6379"}, 1, False),
    ],
)
def test_only_trainings_that_share_a_gpu_of_this_machine_need_mps(options, gpus, shares, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    assert _shares_local_gpus(Sweep("ablation", **options)) is shares
