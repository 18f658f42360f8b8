"""Formats whose file holds the moving scene: the clouds at its key times, and the packages that write it."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np

from warpgs.command_line.progress import progress
from warpgs.command_line.version import install_command
from warpgs.video.camera_paths import evenly_spaced

from .cloud import Cloud
from .job import Job
from .orientation import rotated

KEYS = 30
"""Default number of key times."""

SECONDS = 5.0
"""Default duration [s]."""

OPTIONS = ("keys", "seconds", "up")


def clouds_over_time(job: Job, count: int) -> Iterator[Cloud]:
    """The scene at ``count`` times, evenly spaced over [0, 1], with y up and the same Gaussians at all of them.

    Gaussians with values that are not finite at any of the times are omitted.
    """
    times = evenly_spaced(count)
    finite = np.logical_and.reduce([job.clouds.at(time).finite for time in times])
    rotation = job.rotation(y_up=True)
    for time in progress(times, "exporting", job.options.quiet):
        yield rotated(job.clouds.at(time).select(finite), rotation)


def required(path: Path, module: str, package: str) -> ModuleType:
    """A module of an optional package that writes a file.

    Raises:
        OSError: If the package is not installed; the message names it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise OSError(f"{path} needs {package}: {install_command('export')}") from error
