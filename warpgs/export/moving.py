"""Formats whose file holds the moving scene: the clouds at its key times, and the packages that write it."""

from collections.abc import Iterator

import numpy as np

from warpgs.command_line.progress import progress
from warpgs.formats.cloud import Cloud
from warpgs.formats.rotation import rotated
from warpgs.video.camera_paths import evenly_spaced

from .job import Job

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
