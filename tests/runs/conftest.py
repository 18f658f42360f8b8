"""Fixtures of the tests of run folders."""

import dataclasses

import pytest

from tests import tiny
from tests.runs.folders import create
from warpgs.captures.opening import load_capture


@pytest.fixture(scope="module")
def capture(data):
    return load_capture(data)


@pytest.fixture
def run(tmp_path, capture):
    """The folder of a run that has not begun."""
    return create(dataclasses.replace(tiny.CONFIG, out=tmp_path / "run"), capture)
