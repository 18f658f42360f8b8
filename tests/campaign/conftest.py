"""How long a campaign is: ``pytest tests/campaign --campaign 10000``."""

import pytest

DEFAULT = 60


def pytest_addoption(parser):
    parser.addoption("--campaign", type=int, default=DEFAULT, help="malformed inputs of each kind")


@pytest.fixture(scope="session")
def count(request):
    return request.config.getoption("--campaign", DEFAULT)
