"""``warpgs export``: writes a trained scene for other programs."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

from warpgs.files import remove_numbered
from warpgs.progress import progress
from warpgs.runs.run import Run
from warpgs.video import camera_paths

from .baking import bake, baked_bytes
from .cloud import Cloud
from .clouds import Clouds
from .command import Export
from .compressed import write_compressed
from .opening import find_capture, opening, weighing_cameras
from .page import MAX_KEYS, Start, check_size, write_page
from .standard import write_standard

KEYS, SECONDS, MAX_MEGABYTES = 30, 5.0, 256.0
"""Of a page, where left out."""

OF_FILES, OF_PAGES = ("time", "frames"), ("keys", "seconds", "max_megabytes")
"""Options that only PLY files, or only a page, have."""

WRITERS: dict[str, tuple[str, Callable[[Path, Cloud], int]]] = {
    "ply": (".ply", write_standard),
    "compressed": (".compressed.ply", write_compressed),
}


def export_run(options: Export) -> str:
    """Does what the command was asked; returns a text for people.

    Raises:
        ValueError: If the run or an option can't be used, or a page would be too large.
        OSError: If something can't be written.
    """
    _check(options)
    run = Run.open(options.run_folder, "cpu", options.data)
    clouds = Clouds(run.trained_scene())
    folder = options.out or options.run_folder / "export"
    most, is_page = options.max_gaussians, options.format == "html"
    if is_page and most is None:
        _check_page(options, clouds)  # before the capture is opened: that can take a minute
    capture, origin = find_capture(run, options.quiet) if is_page or most is not None else (None, "")
    if most is not None:
        clouds = clouds.most_visible(most, weighing_cameras(clouds, capture), options.quiet)
    if not is_page:
        return _export_files(options, clouds, folder)
    _check_page(options, clouds)
    start = opening(clouds, capture, options.keys or KEYS, options.seconds or SECONDS)
    return f"{_export_page(options, clouds, start, folder)}\n{origin}"


def _check(options: Export) -> None:
    if options.data is not None and not options.data.is_dir():
        raise ValueError(f"--data {options.data} is no folder")
    is_page = options.format == "html"
    for name in OF_FILES if is_page else OF_PAGES:
        if getattr(options, name) is not None:
            meant = "PLY files; a page plays all of time" if is_page else "--format html"
            raise ValueError(f"{_option(name)} is for {meant}")
    if is_page and options.layers != "all":
        raise ValueError("--layers is for PLY files; a page has both and shows either")
    if options.time is not None and options.frames is not None:
        raise ValueError("--frames are spread over all of time: leave out --time")
    if options.time is not None and not 0 <= options.time <= 1:
        raise ValueError(f"--time must be in [0, 1], got {options.time}")
    if options.frames is not None and not 1 <= options.frames <= camera_paths.MAX_FRAMES:
        raise ValueError(f"--frames must be between 1 and {camera_paths.MAX_FRAMES:,}, got {options.frames}")
    if options.keys is not None and not 1 <= options.keys <= MAX_KEYS:
        raise ValueError(f"--keys must be between 1 and {MAX_KEYS}, got {options.keys}")
    if options.max_gaussians is not None and options.max_gaussians < 1:
        raise ValueError(f"--max-gaussians must be at least 1, got {options.max_gaussians}")
    for name in ("seconds", "max_megabytes"):
        value = getattr(options, name)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{_option(name)} must be positive, got {value}")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _export_files(options: Export, clouds: Clouds, folder: Path) -> str:
    """One PLY file a moment and a layer."""
    times = [options.time or 0.0] if options.frames is None else camera_paths.evenly_spaced(options.frames)
    names = {"all": ["scene"], "apart": ["static", "dynamic"]}.get(options.layers, [options.layers])
    suffix, write = WRITERS[options.format]
    if options.frames is not None:
        for name in names:  # of a longer sequence before this one
            remove_numbered(folder, partial(_numbered, name, suffix))
    num_files, size, largest = 0, 0, 0
    for k, time in enumerate(progress(times, "exporting", options.quiet or len(times) == 1)):
        cloud = clouds.at(time)
        for name in names:
            rows = cloud.finite if name == "scene" else cloud.finite & (cloud.is_dynamic == (name == "dynamic"))
            file = name + suffix if options.frames is None else _numbered(name, suffix, k)
            size += write(folder / file, cloud.select(rows))
            num_files, largest = num_files + 1, max(largest, int(rows.sum()))
    files = "1 file of" if num_files == 1 else f"{num_files} files of up to"
    return f"{files} {largest:,} Gaussians in {folder}, {size / 1e6:.1f} MB"


def _numbered(name: str, suffix: str, number: int) -> str:
    return f"{name}_{number:05d}{suffix}"


def _check_page(options: Export, clouds: Clouds) -> None:
    """Refuses a page that would be too large."""
    cloud, keys = clouds.at(0.0), options.keys or KEYS
    num_static, num_dynamic = int((~cloud.is_dynamic).sum()), int(cloud.is_dynamic.sum())
    check_size({"static": num_static, "dynamic": num_dynamic}, keys)
    size = baked_bytes(num_static, num_dynamic, keys, cloud.sh.shape[1] - 1)
    most = options.max_megabytes or MAX_MEGABYTES
    if size > most * 1e6:
        fitting = int(len(cloud) * most * 1e6 / size)
        raise ValueError(
            f"the page would hold {size / 1e6:.0f} MB for {len(cloud):,} Gaussians at {keys} key times, more "
            f"than {most:g} MB: use about --max-gaussians {fitting}, fewer --keys, or --max-megabytes"
        )


def _export_page(options: Export, clouds: Clouds, start: Start, folder: Path) -> str:
    """One page that plays the scene."""
    baked = bake(clouds.at, progress(camera_paths.evenly_spaced(options.keys or KEYS), "baking", options.quiet))
    written = write_page(folder / "scene.html", baked, start, options.quiet)
    num = f"{len(baked.static):,} static and {len(baked.dynamic):,} dynamic Gaussians at {baked.keys} key times"
    return f"{folder / 'scene.html'}: {num}, {written / 1e6:.1f} MB"
