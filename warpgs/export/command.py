"""The command that writes a run for other programs."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs import paths
from warpgs.progress import progress

from .baking import bake, baked_bytes
from .cloud import Cloud
from .compressed import write_compressed
from .moments import Moments
from .opening import find_capture, opening, weighing_cameras
from .page import MOST_KEYS, write_page
from .standard import write_standard

MOST_FRAMES = 100_000
WRITERS: dict[str, tuple[str, Callable[[Path, Cloud], int]]] = {
    "ply": (".ply", write_standard),
    "compressed": (".compressed.ply", write_compressed),
}


@dataclass(frozen=True)
class Export:
    """Writes a run's newest checkpoint for other programs: PLY of 3DGS, compressed PLY, or a page that plays it."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folder."""
    format: Literal["ply", "compressed", "html"] = "ply"
    """PLY as 3DGS has it; the compressed PLY of SuperSplat and PlayCanvas; one HTML file that plays offline."""
    out: Path | None = None
    """Folder to write into; RUN/export if left out."""
    time: float = 0.0
    """Moment in [0, 1] of a PLY file."""
    frames: int | None = None
    """Write a PLY file for each of so many moments, evenly spread over [0, 1]."""
    layers: Literal["all", "static", "dynamic", "apart"] = "all"
    """Which Gaussians go into PLY files; apart makes a file of the static and one of the dynamic ones."""
    keys: int = 30
    """Key times of a page; it mixes between them."""
    seconds: float = 5.0
    """How long a page takes to play the scene."""
    max_gaussians: int | None = None
    """Keep no more than these, the ones that the filming camera sees most of."""
    max_megabytes: float = 256.0
    """Refuse a page whose Gaussians take more than this, before compression [MB]."""
    data: Path | None = None
    """Where the capture is now, if it was moved; a page begins at its cameras."""
    quiet: bool = False
    """Show no progress."""

    def run(self) -> None:
        print(export_run(self))


def export_run(options: Export) -> str:
    """Does what the command was asked; returns a text for people.

    Raises:
        ValueError: If the run or an option can't be used, or a page would be too large.
        OSError: If something can't be written.
    """
    _check(options)
    if options.data is not None and not options.data.is_dir():
        raise ValueError(f"--data {options.data} is no folder")
    moments = Moments.of_run(options.run_folder, options.data)
    folder = options.out or options.run_folder / "export"
    if options.max_gaussians is not None:
        capture, _ = find_capture(moments, options.quiet)
        moments = moments.lightest_left_out(options.max_gaussians, weighing_cameras(moments, capture), options.quiet)
    if options.format == "html":
        return _export_page(options, moments, folder)
    return _export_files(options, moments, folder)


def _check(options: Export) -> None:
    if not 0 <= options.time <= 1:
        raise ValueError(f"--time must be in [0, 1], got {options.time}")
    if options.frames is not None and not 1 <= options.frames <= MOST_FRAMES:
        raise ValueError(f"--frames must be between 1 and {MOST_FRAMES:,}, got {options.frames}")
    if not 1 <= options.keys <= MOST_KEYS:
        raise ValueError(f"--keys must be between 1 and {MOST_KEYS}, got {options.keys}")
    for name in ("seconds", "max_megabytes"):
        value = getattr(options, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}")
    if options.format == "html" and options.frames is not None:
        raise ValueError("--frames is for PLY files; a page has --keys")
    if options.format == "html" and options.layers != "all":
        raise ValueError("--layers is for PLY files; a page has both and shows either")


def _export_files(options: Export, moments: Moments, folder: Path) -> str:
    """One PLY file a moment and a layer."""
    times = [options.time] if options.frames is None else paths.evenly(options.frames)
    names = {"all": ["scene"], "apart": ["static", "dynamic"]}.get(options.layers, [options.layers])
    suffix, write = WRITERS[options.format]
    num_files, size, largest = 0, 0, 0
    for k, time in enumerate(progress(times, "exporting", options.quiet or len(times) == 1)):
        cloud = moments.at(time)
        for name in names:
            rows = cloud.finite if name == "scene" else cloud.finite & (cloud.is_dynamic == (name == "dynamic"))
            numbered = name if options.frames is None else f"{name}_{k:05d}"
            size += write(folder / (numbered + suffix), cloud.select(rows))
            num_files, largest = num_files + 1, max(largest, int(rows.sum()))
    files = "1 file" if num_files == 1 else f"{num_files} files"
    return f"{files} of up to {largest:,} Gaussians in {folder}, {size / 1e6:.1f} MB"


def _export_page(options: Export, moments: Moments, folder: Path) -> str:
    """One page that plays the scene."""
    cloud = moments.at(0.0)
    counts = (int((~cloud.is_dynamic).sum()), int(cloud.is_dynamic.sum()))
    size = baked_bytes(*counts, options.keys, cloud.sh.shape[1] - 1)
    if size > options.max_megabytes * 1e6:
        fitting = int(len(cloud) * options.max_megabytes * 1e6 / size)
        raise ValueError(
            f"the page would hold {size / 1e6:.0f} MB for {len(cloud):,} Gaussians at {options.keys} key times, more "
            f"than {options.max_megabytes:g} MB: use about --max-gaussians {fitting}, fewer --keys, or --max-megabytes"
        )
    capture, origin = find_capture(moments, options.quiet)
    start = opening(moments, capture, options.keys, options.seconds)
    times = progress(paths.evenly(options.keys), "baking", options.quiet)
    baked = bake(moments.at, times)
    written = write_page(folder / "scene.html", baked, start, options.quiet)
    num = f"{len(baked.static):,} static and {len(baked.dynamic):,} dynamic Gaussians at {options.keys} key times"
    return f"{folder / 'scene.html'}: {num}, {written / 1e6:.1f} MB\n{origin}"
