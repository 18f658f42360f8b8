"""Fixtures of all tests; every annotated shape and type of the package is checked at run time while they run."""

import os
from pathlib import Path

import jaxtyping

from tests import typechecks

# The kernels lie outside this folder and are omitted: Warp reads their annotations itself.
PACKAGE = Path(__file__).parent.parent / "warpgs"
CHECKED = [
    f"warpgs.{path.stem}" for path in PACKAGE.iterdir() if path.stem not in ("__init__", "__pycache__", "kernels")
]
jaxtyping.jaxtyped = typechecks.jaxtyped
jaxtyping.install_import_hook(CHECKED, "tests.typechecks.check")

import pytest  # noqa: E402
import torch  # noqa: E402


def pytest_addoption(parser):
    parser.addoption("--cluster", action="store_true", help="also run tests that kill nodes of a Ray cluster (minutes)")


def pytest_configure(config):
    """Files in their order: with those of few tests last, a single long one would keep one of two workers busy."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    _share_cores(int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1)))


def _share_cores(num_workers: int) -> None:
    """Gives each of several workers, and its processes, a part of the cores: threads that wait for others spin."""
    if num_workers > 1:
        num = max(1, (os.cpu_count() or 1) // num_workers)
        torch.set_num_threads(num)
        os.environ.setdefault("OMP_NUM_THREADS", str(num))


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory) -> Path:
    """A run folder, trained once for all tests, which leave it as it is; its capture is ``../capture``."""
    from tests import tiny  # after the import hook

    return tiny.finished(tmp_path_factory.mktemp("finished"))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """The folder of a small built-in capture, which tests leave as it is."""
    from tests import tiny

    return tiny.write(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def quickly():
    """Disables what costs more time than it saves in trainings of a second."""
    from tests import tiny

    with tiny.in_haste():
        yield


@pytest.fixture
def contracts_off():
    """Turns the run-time checks of annotations off, so that the package's own checks have the word."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
