"""Fixtures of the tests of captures and layouts."""

import shutil

import pytest

from tests.data import layouts
from tests.data.captures import write_capture
from tests.prepare import boards


@pytest.fixture
def root(tmp_path):
    """A capture in the layout of NeRF-DS."""
    return write_capture(tmp_path / "toy")


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """The folder of each layout, which tests leave as it is."""
    root = tmp_path_factory.mktemp("layouts")
    return {name: write(root / name) for name, write in layouts.ALL.items()}


@pytest.fixture(scope="session")
def with_boards(tmp_path_factory):
    """A capture of moving boards, which tests leave as it is."""
    root = boards.write_capture(tmp_path_factory.mktemp("boards") / "capture")
    shutil.rmtree(root / "frames")
    return root


@pytest.fixture
def without_motion(monkeypatch):
    """Checks do not compare motion, which takes most of their time and says nothing of depth and points."""
    monkeypatch.setattr("warpgs.captures.check.motions_of", lambda *_: [])
    monkeypatch.setattr("warpgs.captures.check.check_turning", lambda *_: [])


@pytest.fixture
def edited(written, tmp_path):
    """A function that copies a layout's folder, to be changed."""
    return lambda layout: shutil.copytree(written[layout], tmp_path / "copy")
