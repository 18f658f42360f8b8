"""Captures in released archives, unpacked within bounds: completely or not at all."""

import shutil
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from warpgs.data.archive import Archive
from warpgs.data.published import Release
from warpgs.files import complete_or_absent, kept_if_used, write_bytes

MARKERS = ("dataset.json", "transforms_train.json")
"""Files of which a released capture has one."""

MAX_MEMBERS, MAX_MEMBER, MAX_TOTAL = 200_000, 1 << 30, 64 << 30
"""Maximum number of files in an archive, and maximum size of one and of all that are unpacked [bytes]."""

DEBRIS = "__MACOSX"
"""Folder of metadata in archives that macOS made."""


def unpack(path: Path, release: Release, scene: str, folder: Path, progress: Callable[[int, int], object]) -> int:
    """Unpacks a capture from the archive of a release; returns the number of files.

    Args:
        path: The archive.
        release: The release.
        scene: Name of the capture.
        folder: Folder of the capture, which does not exist or is empty.
        progress: Receives how many files are done, and of how many.

    Raises:
        ValueError: If the archive is damaged, does not have the capture, is larger than the bounds, or has a name that
            leads out of the folder.
        OSError: If a file cannot be written.
    """
    archive = Archive(path)
    if len(archive.sizes) > MAX_MEMBERS:
        raise ValueError(f"{path} has {len(archive.sizes):,} files, more than the maximum of {MAX_MEMBERS:,}")
    archive.require_plain()
    root = _find(archive, release, scene)
    names = [name for name in archive.sizes if not name.endswith("/") and root in PurePosixPath(name).parents]
    total = sum(archive.sizes[name] for name in names)
    if total > MAX_TOTAL:
        raise ValueError(f"{path}: {scene} has {total:,} bytes, more than the maximum of {MAX_TOTAL:,}")
    with kept_if_used(folder.parent), complete_or_absent(folder) as partial:
        if total > (free := shutil.disk_usage(partial).free):
            raise OSError(f"{folder} needs {total:,} bytes, but there are only {free:,} free")
        for done, (name, content) in enumerate(archive.read_all(names, MAX_MEMBER)):
            write_bytes(partial / PurePosixPath(name).relative_to(root), [content])
            progress(done + 1, len(names))
    return len(names)


def _find(archive: Archive, release: Release, scene: str) -> PurePosixPath:
    """The folder of a capture in an archive."""
    paths = [path for path in map(PurePosixPath, archive.sizes) if DEBRIS not in path.parts]
    captures = sorted({path.parent for path in paths if path.name in MARKERS})
    found = [path for path in captures if path.name in (scene, f"{scene}{release.suffix}")]
    if not found and len(release.scenes) == 1:
        found = captures
    if len(found) != 1:
        has = ", ".join(map(str, captures)) or "none"
        raise ValueError(f"{archive.path} must have one capture {scene}, but its captures are: {has}")
    return found[0]
