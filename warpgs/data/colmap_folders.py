"""Where a capture has COLMAP models, and which one is used.

COLMAP's mapper writes sparse/0, sparse/1, … when images do not connect, in no order of size; colmap image_undistorter
writes sparse/ and images/ into a folder, dense/ in COLMAP's documentation, its automatic reconstruction dense/0,
dense/1, …; other programs write the files next to images/.
"""

from pathlib import Path
from typing import NamedTuple

from warpgs.errors import counted
from warpgs.files import natural_order, read_bounded

from .colmap_files import MAX_BYTES, REQUIRED

PLACES = "sparse/0, sparse, colmap/sparse/0, dense/sparse, dense/0/sparse or the folder itself"
"""Where models are looked for, for messages."""


class ModelFolder(NamedTuple):
    """The folder of a model.

    Attributes:
        folder: The folder.
        part: The folder with its images/, masks/ and depths/: the capture itself, or one in dense.
    """

    folder: Path
    part: Path

    @property
    def has_images(self) -> bool:
        """Whether the folder images/ is there."""
        return (self.part / "images").is_dir()

    def shown(self, root: Path) -> str:
        """The folder in a capture's folder, for messages."""
        return "the folder itself" if self.folder == root else str(self.folder.relative_to(root))

    def num_images(self) -> int:
        """Number of images with a pose as far as the files say it without being read; 0 if a file is missing."""
        for suffix in (".bin", ".txt"):
            if all((self.folder / f"{name}{suffix}").is_file() for name in REQUIRED):
                return _count(self.folder / f"images{suffix}")
        return 0


def find_models(root: Path) -> list[ModelFolder]:
    """The models in a capture's folder, those first that are preferred among models of one size."""
    dense = [root / "dense", *_subfolders(root / "dense")]
    found = []
    for part in (root, *dense):
        bases = [part / "sparse", part / "colmap/sparse"]
        within = [folder for base in bases for folder in (*_subfolders(base), base)]
        numbered = [folder for folder in _subfolders(part) if folder.name.isdecimal()] if part == root else []
        found += [ModelFolder(folder, part) for folder in within if _has_file(folder, REQUIRED)]
        found += [ModelFolder(folder, part) for folder in (*numbered, part) if _has_file(folder, REQUIRED[:1])]
    return found


def largest_model(root: Path) -> tuple[ModelFolder | None, list[str]]:
    """The model with the most images among those with a folder of images, and a note that names the others."""
    found = [model for model in find_models(root) if model.has_images]
    if len(found) < 2:
        return (found[0] if found else None), []
    counts = [model.num_images() for model in found]
    best = counts.index(max(counts))
    shown = [f"{model.shown(root)} ({counted(count, 'image')})" for model, count in zip(found, counts, strict=True)]
    used = shown.pop(best)
    few, more = ", ".join(shown[:4]), f" and {len(shown) - 4} more" if len(shown) > 4 else ""
    rank = "the largest" if counts.count(max(counts)) == 1 else "the first of the largest"
    return found[best], [f"the COLMAP model in {used} is read as {rank}; skipped: {few}{more}"]


def _subfolders(folder: Path) -> list[Path]:
    try:
        found = [path for path in folder.iterdir() if path.is_dir()]
    except OSError:  # no folder, or one that cannot be read
        return []
    return sorted(found, key=lambda path: (not path.name.isdecimal(), natural_order(path.name)))


def _has_file(folder: Path, names: tuple[str, ...]) -> bool:
    return any((folder / f"{name}{suffix}").is_file() for name in names for suffix in (".bin", ".txt"))


def _count(path: Path) -> int:
    """Number of images in images.bin or images.txt."""
    if path.suffix == ".bin":
        with path.open("rb") as file:
            return min(int.from_bytes(file.read(8), "little"), path.stat().st_size // 64)
    try:
        lines = read_bounded(path, MAX_BYTES).split(b"\n")
    except ValueError:  # the loader reports it
        return 0
    return len([line for line in lines if not line.lstrip().startswith(b"#")]) // 2
