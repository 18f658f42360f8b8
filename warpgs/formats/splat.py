"""Reads .splat of antimatter15's viewer: 32 bytes per Gaussian, colours of degree 0, in the axes of the PLY file.

https://github.com/antimatter15/splat: three floats of the centre, three linear scales, red, green, blue and opacity as
bytes, and the quaternion (w, x, y, z) as bytes around 128.
"""

from pathlib import Path

import numpy as np

from warpgs.files import read_bounded
from warpgs.model.gaussians import SH_C0

from .bounds import MAX_BYTES
from .cloud import MIN_SCALE, Cloud, logit, unit_quats

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def read_splat(path: Path) -> Cloud:
    """Reads the Gaussians of a .splat file; raises ValueError, which names it, if it is damaged."""
    data = read_bounded(path, MAX_BYTES)
    if len(data) % ROW.itemsize:
        raise ValueError(f"{path} is damaged: {len(data):,} bytes are no multiple of {ROW.itemsize}")
    rows = np.frombuffer(data, ROW)
    colors = rows["color"] / 255
    return Cloud(
        means=rows["mean"].copy(),
        quats=unit_quats(rows["quat"].astype(np.float32) - 128),
        log_scales=np.log(np.maximum(rows["scale"], MIN_SCALE)).astype(np.float32),
        logit_opacities=logit(colors[:, 3]).astype(np.float32),
        sh=((colors[:, None, :3] - 0.5) / SH_C0).astype(np.float32),
        is_dynamic=np.zeros(len(rows), bool),
    )
