"""Jumps of exposure and white balance between the frames of a capture."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.data.responses import BRIGHTEST, DARKEST, MIN_JUMP
from warpgs.views.glance import Glance
from warpgs.views.views import Views

MIN_PIXELS = 50
"""Minimum number of compared pixels; between two frames with fewer, no jump is assumed."""


def exposure_gains(views: Views) -> Float[Tensor, "T 3"]:
    """How much brighter each training frame is than most, per channel; exactly 1 without jumps.

    Intensities are multiplied by about a constant when a camera's exposure or white balance jumps. In the order of
    time, each frame is compared with the one before of its camera: the median of the ratio of their static pixels.
    Ratios close to 1 are taken as 1, so that gradual changes stay: of one camera, the appearance network represents
    them, and dividing them out would only hide them from held-out frames; of several, see ``camera_responses``.

    Returns:
        [T, 3] factors of red, green and blue, in the order of the views; their median over frames of a camera is 1.
    """
    logs = torch.zeros(len(views), 3, dtype=torch.float32)
    for video in views.videos:
        log, before = torch.zeros(3, dtype=torch.float32), None
        for k in video:
            after = _log_intensities(views.glances[k])
            if before is not None:
                log = log + _jump(before, after)
            logs[k], before = log, after
        logs[video] -= logs[video].median(0).values
    logs[logs.abs().amax(1) < MIN_JUMP] = 0.0  # what rounding leaves of a jump and of the one back
    return logs.exp()


def _log_intensities(glance: Glance) -> np.ndarray:
    """[h, w, 3] logarithms of the small image; NaN where not compared."""
    values = glance.colors.astype(np.float32) / 255.0
    values[~glance.is_static] = np.nan
    values[(values < DARKEST) | (values > BRIGHTEST)] = np.nan
    return np.log(values)


def _jump(before: np.ndarray, after: np.ndarray) -> Float[Tensor, "3"]:
    """Change of the logarithms of red, green and blue from one small image to the next; 0 if it is no jump."""
    if before.shape != after.shape:
        return torch.zeros(3, dtype=torch.float32)
    change = (after - before).reshape(-1, 3)
    known = np.isfinite(change).all(1)
    if known.sum() < MIN_PIXELS:
        return torch.zeros(3, dtype=torch.float32)
    median = torch.from_numpy(np.median(change[known], axis=0))
    return median if bool(median.abs().max() >= MIN_JUMP) else torch.zeros(3, dtype=torch.float32)
