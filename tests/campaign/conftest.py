"""How long a campaign is: ``pytest tests/campaign --campaign 10000 --minutes 30``."""

import pytest

DEFAULT = 60


def pytest_addoption(parser):
    parser.addoption("--campaign", type=int, default=DEFAULT, help="malformed inputs of each kind")
    parser.addoption("--minutes", type=float, default=0.0, help="time for trainings and visits whose memory is watched")


@pytest.fixture(scope="session")
def count(request):
    return request.config.getoption("--campaign", DEFAULT)


@pytest.fixture(scope="session")
def minutes(request):
    return request.config.getoption("--minutes", 0.0)
