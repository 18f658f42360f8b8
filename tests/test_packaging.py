"""What is installed: every package and data file, under one version."""

import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

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


def test_the_oldest_versions_that_are_tested_are_the_oldest_that_are_accepted(project):
    lines = (ROOT / "constraints-oldest.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    required = [*project["project"]["dependencies"], *project["project"]["optional-dependencies"]["dev"]]
    required = [r for r in map(Requirement, required) if not r.marker and r.name not in CHECKERS]
    bounds = {r.name: s.version for r in required for s in r.specifier if s.operator == ">="}
    assert {name: release(version) for name, version in pinned.items()} == {n: release(v) for n, v in bounds.items()}


CHECKERS = {"mypy", "ruff"}
"""What the tests do not need."""


def release(version):
    """The first three numbers of a version; OpenCV has a fourth, of the package alone."""
    return (*Version(version).release, 0, 0)[:3]


def test_the_package_index_shows_the_pythons_that_are_accepted(project):
    shown = [c.rpartition(" ")[2] for c in project["project"]["classifiers"] if ":: Python :: 3." in c]
    accepted = SpecifierSet(project["project"]["requires-python"])
    assert shown
    assert all(version in accepted for version in shown)
    assert "3.9" not in accepted
    assert shown[0] == project["tool"]["mypy"]["python_version"]


def test_the_image_has_no_build_tools_and_no_root():
    """Its caches lie in its volume, which is also where its runs go."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    build, image = re.split(r"^FROM ", text, flags=re.MULTILINE)[1:]
    assert "pip install" in build
    assert "pip install" not in image
    steps = [line.split(maxsplit=1) for line in image.splitlines()[1:] if line]
    values = dict(step for step in steps if step[0] != "ENV")
    variables = dict(v.split("=", 1) for name, value in steps if name == "ENV" for v in value.split())
    assert values["USER"] not in ("root", "0")
    assert values["WORKDIR"] == values["VOLUME"]
    assert all(variables[name].startswith(values["VOLUME"]) for name in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"))
    assert f"install -d -o {values['USER']} {values['VOLUME']}" in values["RUN"]
    copied = re.findall(r"^COPY (?!--from)(\S+)", text, re.MULTILINE)
    assert all((ROOT / name).exists() for name in copied)


def test_python_3_10_gets_the_parser_of_toml_that_sweep_imports(project):
    markers = {r.name: r.marker for r in map(Requirement, project["project"]["dependencies"])}
    assert markers["tomli"].evaluate({"python_version": "3.10"})
    assert not markers["tomli"].evaluate({"python_version": "3.11"})
