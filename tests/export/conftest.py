"""Fixtures of the tests of exports."""

import pytest

from tests.export import scenes


@pytest.fixture(scope="module")
def clouds():
    """Clouds that tests leave as they are."""
    return scenes.clouds()


@pytest.fixture
def path(tmp_path):
    """A file to write; none of the writers asks for a suffix."""
    return tmp_path / "scene"
