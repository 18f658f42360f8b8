"""What is installed: every package and data file, under one version."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def project():
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_is_installed(project):
    folders = [path.parent for path in (ROOT / "warpgs").rglob("__init__.py")]
    packages = {".".join(folder.relative_to(ROOT).parts) for folder in folders} | {"warpgs.kernels"}
    assert set(project["tool"]["setuptools"]["packages"]) == packages


def test_every_file_that_is_no_module_is_installed(project):
    data = project["tool"]["setuptools"]["package-data"]
    installed = {
        path for name, patterns in data.items() for p in patterns for path in (ROOT / name.replace(".", "/")).glob(p)
    }
    others = {p for p in (ROOT / "warpgs").rglob("*") if p.is_file() and p.suffix != ".py"}
    assert {path for path in others if "__pycache__" not in path.parts} == installed


def test_the_version_is_the_same_everywhere(project):
    version = project["project"]["version"]
    assert re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == version
    assert f"\n## {version}\n" in (ROOT / "CHANGELOG.md").read_text()
