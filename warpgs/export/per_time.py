"""Formats whose files hold one time: one file per time and layer."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from warpgs.command_line.progress import progress
from warpgs.errors import counted
from warpgs.files import remove_numbered
from warpgs.formats.cloud import Cloud
from warpgs.formats.rotation import rotated
from warpgs.video.camera_paths import evenly_spaced

from .job import Job, Writer

OPTIONS = ("time", "frames", "layers", "up")


def per_time(suffix: str, write_cloud: Callable[[Path, Cloud], int], y_up: bool = False) -> Writer:
    """A format with one file per time and layer.

    Args:
        suffix: End of the file names, with its dot.
        write_cloud: Writes a cloud and returns the size of the file [bytes].
        y_up: Whether readers assume that y points up, as in glTF, instead of down, as in the PLY file of 3DGS.
    """
    write = partial(_write, suffix, write_cloud, y_up)
    return Writer(write, OPTIONS, Path(f"scene{suffix}").suffix, y_up=y_up)


def _write(suffix: str, write_cloud: Callable[[Path, Cloud], int], y_up: bool, job: Job) -> str:
    options, folder = job.options, job.folder
    rotation = job.rotation(y_up)
    times = [options.time or 0.0] if options.frames is None else evenly_spaced(options.frames)
    names = {"all": ["scene"], "apart": ["static", "dynamic"]}.get(options.layers, [options.layers])
    if options.frames is not None:
        for name in names:  # an earlier sequence may have been longer
            remove_numbered(folder, partial(_numbered, name, suffix))
    num_files, size, max_count = 0, 0, 0
    for k, time in enumerate(progress(times, "exporting", options.quiet or len(times) == 1)):
        cloud = rotated(job.clouds.at(time), rotation)
        for name in names:
            rows = cloud.finite if name == "scene" else cloud.finite & (cloud.is_dynamic == (name == "dynamic"))
            file = name + suffix if options.frames is None else _numbered(name, suffix, k)
            size += write_cloud(job.file(file), cloud.select(rows))
            num_files, max_count = num_files + 1, max(max_count, int(rows.sum()))
    count = counted(max_count, "Gaussian")
    written = f"{job.file(file)}: {count}" if num_files == 1 else f"{num_files} files of up to {count} in {folder}"
    if options.frames is None:
        written += f" at time {times[0]:g} of 0 to 1"
    return f"{written}, {size / 1e6:.1f} MB\n{job.up_note}"


def _numbered(name: str, suffix: str, number: int) -> str:
    return f"{name}_{number:05d}{suffix}"
