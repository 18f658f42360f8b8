"""A video of boards before a wall, with known cameras."""

import pytest

from tests.prepare import boards


@pytest.fixture(scope="module")
def video():
    return boards.record(24)


@pytest.fixture(scope="module")
def frames(video):
    return boards.posed(video[0])
