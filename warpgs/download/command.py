"""The command ``warpgs download``."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path

from warpgs.cache import cache_folder
from warpgs.command_line.progress import progress_of_steps
from warpgs.command_line.screen import show
from warpgs.data.archive import DamagedError
from warpgs.data.published import PUBLISHED, Published, Release, find_dataset
from warpgs.errors import command, not_one_of, terminable

from .fetch import fetch
from .options import Download
from .unpack import MARKERS, unpack


def run(options: Download) -> None:
    """Downloads captures, or lists those that there are; raises as ``download``."""
    if options.dataset is None:
        show(listing())
        return
    dataset = find_dataset(options.dataset)
    if dataset is None:
        raise ValueError(not_one_of("DATASET", options.dataset, [dataset.name for dataset in PUBLISHED]))
    with terminable():
        folders = download(dataset, options.scenes, options.to)
    if len(folders) == 1:
        show(f"{command('train', '--data', *folders)} trains on it")
    else:
        show(f"{command('sweep', 'scenes', '--data', folders[0].parent)} makes a table of them")


def listing() -> str:
    """All datasets, with their scenes or how to get them."""
    lines = ["warpgs download DATASET [SCENE ...], of:"]
    for dataset in PUBLISHED:
        text = ", ".join(dataset.scenes) or f"by hand from {dataset.address}: {dataset.by_hand}"
        lines.append(f"  {dataset.name:<13} {text}")
    return "\n".join(lines)


def download(dataset: Published, scenes: Collection[str], to: Path, show: Callable[[str], object] = show) -> list[Path]:
    """Downloads captures of a dataset; those that are there are kept as they are.

    Args:
        dataset: The dataset.
        scenes: Scenes of it; all if empty.
        to: Folder for the folder of the dataset.
        show: Receives what is done.

    Returns:
        Their folders.

    Raises:
        ValueError: If the dataset must be downloaded by hand, does not have a scene, the folder of a scene has other
            files, or an archive is not as expected.
        OSError: If an archive cannot be downloaded, or a file cannot be written.
    """
    if not dataset.releases:
        raise ValueError(f"{dataset.title} must be downloaded by hand from {dataset.address}: {dataset.by_hand}")
    if unknown := [scene for scene in scenes if scene not in dataset.scenes]:
        raise ValueError(not_one_of("SCENE", unknown[0], dataset.scenes))
    folders = {scene: to / dataset.name / scene for scene in dataset.scenes if scene in scenes or not scenes}
    there = {scene for scene, folder in folders.items() if _is_there(folder)}
    for scene in there:
        show(f"{folders[scene]} is there already")
    archives = cache_folder("downloaded archives") / "archives" / dataset.name
    for release in dataset.releases:
        if missing := [scene for scene in release.scenes if scene in folders and scene not in there]:
            _download(release, {scene: folders[scene] for scene in missing}, archives, show)
    return list(folders.values())


def _is_there(folder: Path) -> bool:
    """Whether a folder has a capture; raises ValueError if it has something else."""
    if any((folder / marker).is_file() for marker in MARKERS):
        return True
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder} is not a capture, and not empty: move it away, or choose another folder with --to")
    return False


def _download(release: Release, folders: Mapping[str, Path], archives: Path, show: Callable[[str], object]) -> None:
    """Downloads scenes of a release, each to its folder; archives are kept in another one."""
    path = fetch(release, archives, show)
    try:
        for scene, folder in folders.items():
            with progress_of_steps() as progress:
                count = unpack(path, release, scene, folder, partial(progress, str(folder)))
            show(f"{folder} has {count:,} files of {path}")
    except DamagedError as error:
        path.unlink()
        raise ValueError(f"{error}; it was removed, so that the same command downloads it again") from error
