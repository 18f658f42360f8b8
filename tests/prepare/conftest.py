"""A video of boards before a wall, with known cameras."""

import pytest

from tests.prepare import boards


@pytest.fixture(scope="module")
def video():
    return boards.record(24)


@pytest.fixture
def no_comparison(monkeypatch):
    """Preparations do not compare their frames, which makes doubts known: it takes most of the time of small ones."""
    monkeypatch.setattr("warpgs.prepare.steps.doubts_of_motion", lambda *_: [])


@pytest.fixture(scope="module")
def frames(video):
    return boards.posed(video[0])
