"""Which way is up: scenes have any orientation, but other programs assume that files stand upright.

Readers of the PLY file of 3DGS, and of the formats that hold the same values (compressed PLY, SOG), assume the axes of
COLMAP's cameras: y points down, z away from the viewer. SPZ, glTF and OpenUSD have y up and z towards the viewer; that
is the same after half a turn around x.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64

from warpgs.data.capture import Capture
from warpgs.formats.rotation import Y_DOWN_TO_Y_UP
from warpgs.video.camera_paths import UP, upward

AXES = {
    **{"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)},
    **{"-x": (-1.0, 0.0, 0.0), "-y": (0.0, -1.0, 0.0), "-z": (0.0, 0.0, -1.0)},
}
"""Upward directions by their names."""

MIN_TURN = 0.17
"""Root mean square of the cameras' sideways axes along their second principal direction, below which they are almost
parallel and do not determine what is vertical (nerfstudio)."""


def vertical(capture: Capture) -> Float64[np.ndarray, "3"]:
    """The upward direction of a capture in scene coordinates: that of its training cameras, which are level.

    Cameras may look up or down, but hardly roll: what is up is perpendicular to all their sideways axes, if these
    differ enough (the orientation method "vertical" of nerfstudio, ``auto_orient_and_center_poses``).
    """
    sideways = torch.stack([capture.cameras[name].viewmat[0, :3] for name in capture.train]).double().numpy()
    up = upward(capture).double().numpy()
    _, extents, axes = np.linalg.svd(sideways, full_matrices=False)
    if len(extents) == 3 and extents[1] > MIN_TURN * np.sqrt(len(sideways)):
        up = axes[2] * (1.0 if axes[2] @ up > 0 else -1.0)
    else:
        up = up - axes[0] * (axes[0] @ up)
    return up / np.linalg.norm(up)


def upright(up: Sequence[float] | Float64[np.ndarray, "3"], y_up: bool = False) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation that turns an upward direction to -y; with ``y_up``, then half a turn around x."""
    source, target = np.asarray(up, np.float64), np.asarray(UP)
    source = source / np.linalg.norm(source)
    cosine, axis = source @ target, np.cross(source, target)
    rotation = Y_DOWN_TO_Y_UP.copy()  # for opposite directions
    if cosine > -1 + 1e-9:
        cross = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + cross + cross @ cross / (1 + cosine)
    return Y_DOWN_TO_Y_UP @ rotation if y_up else rotation
