"""The container .4dgs (https://4dgs.dev, package ``fourdgs``), in its temporal model ``keyframe-delta``.

Samples at evenly spaced times; between two of them, Gaussians move in straight lines. A sample stores only the
Gaussians that change: static ones are stored once, and again only where their colour or opacity changes. This model
holds colours of degree 0, the mean over all directions, and the object of each Gaussian (``object_id``). Axes are x
right, y up, z towards the viewer.
"""

import numpy as np

from warpgs.files import write_bytes
from warpgs.formats.cloud import Cloud, sigmoid
from warpgs.formats.packages import required
from warpgs.model.gaussians import SH_C0

from .fourdgs_objects import with_object_ids
from .job import Job, Writer
from .moving import KEYS, OPTIONS, SECONDS, clouds_over_time

PERSISTENCE = 1000.0
"""Standard deviation of a Gaussian's visibility over time, in durations: it does not fade."""

PROFILE = "fine"
"""Position errors of at most 2 % of the median scale, colour errors of half a level."""


def write_fourdgs(job: Job) -> str:
    """Writes one file; returns a summary.

    Raises:
        OSError: If it cannot be written, or fourdgs is not installed; the message says which.
    """
    options, path = job.options, job.file("scene.4dgs")
    keys, seconds = options.keys or KEYS, options.seconds or SECONDS
    fourdgs = required(path, "fourdgs", "fourdgs")
    file, writer = (required(path, f"fourdgs.keyframe_delta_{name}", "fourdgs") for name in ("file", "writer"))
    step, samples = seconds / keys, []
    clouds = clouds_over_time(job, keys + 1)
    cloud = next(clouds)
    for k, following in enumerate(clouds):
        velocity = (following.means - cloud.means) / np.float32(step)
        gaussians = fourdgs.GaussianSet(**_arrays(cloud, velocity, k * step, seconds))
        samples.append(writer.Sample(k * step, np.arange(len(cloud)), gaussians))
        cloud = following
    content = file.write_sequence(samples, seconds, profile=PROFILE, library="warpgs")
    if cloud.objects is not None and cloud.objects.any():
        content = with_object_ids(content, cloud.objects)
    size = write_bytes(path, [content])
    dynamic = int(cloud.is_dynamic.sum())
    count = f"{len(cloud) - dynamic:,} static and {dynamic:,} dynamic Gaussians at {keys} key times"
    return f"{path}: {count}, {size / 1e6:.1f} MB\n{job.up_note}"


def _arrays(cloud: Cloud, velocity: np.ndarray, time: float, seconds: float) -> dict[str, np.ndarray]:
    """The arrays of a ``GaussianSet`` at a time [s]."""
    N = len(cloud)
    opacities = sigmoid(cloud.logit_opacities.astype(np.float64))[:, None]
    return {
        "positions": cloud.means,
        "scales": np.exp(cloud.log_scales),
        "rotations": np.roll(cloud.quats, -1, axis=1),
        "colors": np.concatenate([np.clip(0.5 + SH_C0 * cloud.sh[:, 0], 0, 1), opacities], 1).astype(np.float32),
        "motions": velocity,
        "mu_t": np.full(N, time, np.float32),
        "sigma_t": np.full(N, PERSISTENCE * seconds, np.float32),
        "win_lo": np.zeros(N),
        "win_hi": np.full(N, seconds),
    }


FOURDGS = Writer(write_fourdgs, OPTIONS, ".4dgs", has_objects=True, y_up=True)
