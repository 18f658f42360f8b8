"""Fixtures of the tests of training."""

import dataclasses

import pytest

from tests import tiny
from warpgs.evaluation import evaluate_run


@pytest.fixture
def config(tmp_path, contracts_off, monkeypatch):
    """The config of a short training of a capture of its own, with a video of two frames."""
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    return dataclasses.replace(tiny.CONFIG, data=tiny.write(tmp_path / "capture"), out=tmp_path / "run")
