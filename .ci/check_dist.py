"""Checks that sdist and wheel have every source and data file: ``check_dist.py ROOT DIST``."""

import sys
import tarfile
import zipfile
from pathlib import Path

SDIST = (
    "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "pyproject.toml", "constraints.txt",
    "constraints-oldest.txt", "mkdocs.yml", "train.py",
)  # fmt: skip
"""Files of the root that belong to the sdist, which also has the folders ``FOLDERS``."""

FOLDERS = ("docs", "examples", "tests")


def files(folder: Path) -> list[Path]:
    """All files of a folder but compiled ones."""
    return [path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts]


def missing(root: Path, dist: Path) -> list[str]:
    """Names of the files that the wheel or the sdist lacks."""
    (wheel,), (sdist,) = dist.glob("warpgs-*.whl"), dist.glob("warpgs-*.tar.gz")
    in_wheel = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    package = [path.relative_to(root).as_posix() for path in files(root / "warpgs")]
    kernels = [path.relative_to(root).as_posix() for path in files(root / "kernels")]
    others = [path.relative_to(root).as_posix() for name in FOLDERS for path in files(root / name)]
    lacking = [f"wheel: {name}" for name in [*package, *(f"warpgs/{name}" for name in kernels)] if name not in in_wheel]
    return lacking + [f"sdist: {name}" for name in [*SDIST, *package, *kernels, *others] if name not in in_sdist]


if __name__ == "__main__":
    lacking = missing(Path(sys.argv[1]), Path(sys.argv[2]))
    sys.exit("\n".join(lacking) or 0)
