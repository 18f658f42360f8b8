"""Fixtures of the tests of the viewer."""

import pytest

from tests.viewer import watched


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    """A run whose images are easy to tell apart."""
    return watched.copy(finished_run, tmp_path_factory.mktemp("made"))
