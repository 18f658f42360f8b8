"""Depth of the static scene from several frames, without any network.

Every frame is triangulated against its neighbours by optical flow (``dense``); what moves is left out, and so is what
the neighbours' own depth does not confirm.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from warpgs.files import write_array

from .dense import LocalGeometry, PosedFrames, triangulate
from .parallel import each

MAX_RESIDUAL = 1.5
"""Mean error of a pixel's places above which its depth is not used [px]."""

MAX_RELATIVE_SIGMA = 0.08
"""Standard deviation of inverse depth above which it is not used, as a share of it."""

AGREEMENT = 0.06
"""Relative difference of inverse depths that confirm each other, beside twice their standard deviations."""

MIN_CONFIRMATIONS = 2


def static_depth(
    footage: PosedFrames, moving: Sequence[Bool[np.ndarray, "H W"]], quiet: bool = True
) -> list[Float[np.ndarray, "H W"]]:
    """[H, W] inverse depth of every frame in the units of the poses; NaN where it moves or is not known well.

    Args:
        footage: The frames.
        moving: [H, W] true where each frame moves.
        quiet: Whether to show no progress.
    """
    frames = range(len(footage.poses))
    focal = footage.lens.focal[0]

    def local(frame: int) -> LocalGeometry:
        found = triangulate(footage.observations(frame), focal)
        with np.errstate(invalid="ignore"):
            bad = moving[frame] | ~(found.residual < MAX_RESIDUAL)
            bad |= ~(found.sigma < MAX_RELATIVE_SIGMA * found.inverse_depth)
        found.inverse_depth[bad] = np.nan
        return found

    geometry = each(local, frames, "depth", quiet)
    return each(lambda frame: _confirmed(footage, geometry, frame), frames, "depth: cross-checks", quiet)


def _confirmed(footage: PosedFrames, geometry: Sequence[LocalGeometry], frame: int) -> Float[np.ndarray, "H W"]:
    """The inverse depth that at least two neighbours confirm, or all where there are fewer."""
    rho, sigma = geometry[frame].inverse_depth, geometry[frame].sigma
    lens, near = footage.lens, footage.neighbours(frame)
    votes = np.zeros(rho.shape, np.uint8)
    for other in near:
        rotation, shift = footage.relative(frame, other)
        turned = footage.turned(rotation)
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = turned[2] + rho * shift[2]
            column, row = lens.image((turned[0] + rho * shift[0]) / depth, (turned[1] + rho * shift[1]) / depth)
            seen = (depth > 1e-3) & (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
            x = np.where(seen, column - 0.5, -9.0).astype(np.float32)
            y = np.where(seen, row - 0.5, -9.0).astype(np.float32)
            theirs, theirs_sigma = (_nearest(p, x, y) for p in (geometry[other].inverse_depth, geometry[other].sigma))
            expected, gain = rho / depth, turned[2] / depth**2
            slack = AGREEMENT * expected + 2.0 * np.hypot(gain * sigma, theirs_sigma)
            votes += seen & (np.abs(theirs - expected) < slack)
    return np.where(votes >= min(MIN_CONFIRMATIONS, len(near)), rho, np.float32(np.nan))


def _nearest(plane: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    nothing = (np.nan,) * 4
    return cv2.remap(plane, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nothing)


def write_depth(path: Path, inverse_depth: Float[np.ndarray, "H W"]) -> None:
    """Writes a plane as .npy of half floats, scaled so that they don't run out of range.

    Depth of a capture counts up to scale and offset, so the scale need not be kept.

    Raises:
        OSError: If it can't be written; the message names the file.
    """
    known = inverse_depth[np.isfinite(inverse_depth)]
    scale = (float(np.median(known)) if len(known) else 0.0) or 1.0  # a network may find all of it infinitely far
    write_array(path, np.minimum(inverse_depth / scale, 1e3).astype(np.float16))
