"""Depth of static surfaces by triangulation from optical flow, without a network.

Every frame is triangulated from its neighbours (``triangulation``). Dynamic pixels are omitted, and so are pixels whose
depth the neighbours' own depth does not confirm.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ..cameras.posed_frames import PosedFrames
from ..cameras.triangulation import LocalGeometry, triangulate
from ..frames.flow import Flows
from ..frames.images import brighten
from ..frames.parallel import map_frames

MAX_RESIDUAL = 1.5
"""Maximum residual of a pixel with depth [px]."""

MAX_RELATIVE_SIGMA = 0.08
"""Maximum standard deviation of inverse depth, relative to inverse depth."""

AGREEMENT = 0.06
"""Relative difference of inverse depths that confirm each other, in addition to twice their standard deviations."""

MIN_CONFIRMATIONS = 2


def static_depth(
    frames: PosedFrames, dynamic: Sequence[Bool[np.ndarray, "H W"]], quiet: bool = True
) -> list[Float[np.ndarray, "H W"]]:
    """[H, W] inverse depth of every frame in the units of the poses; NaN where dynamic or not known well.

    The frames have their working size, and a dynamic mask each.
    """
    height, width = frames.images[0].shape[:2]
    frames, indices = frames.halved, range(len(frames.images))  # flow tells no more at full size
    flows, size = Flows(brighten(frames.images), frames.expected_flow), (frames.lens.width, frames.lens.height)

    def local(frame: int) -> LocalGeometry:
        found = (frames.triangulated or {}).pop(frame, None)
        if found is None:
            found = triangulate(frames.observations(frame, flows), frames.focal)
            flows.release(frame)
        covered = np.where(dynamic[frame], 255, 0).astype(np.uint8)
        moves = cv2.resize(covered, size, interpolation=cv2.INTER_AREA) > 0  # a part of a pixel is enough
        with np.errstate(invalid="ignore"):
            bad = moves | ~(found.residual < MAX_RESIDUAL)
            bad |= ~(found.sigma < MAX_RELATIVE_SIGMA * found.inverse_depth)
        found.inverse_depth[bad] = np.nan
        return found

    geometry = map_frames(local, indices, "depth", quiet)
    confirmed = map_frames(lambda frame: _confirmed(frames, geometry, frame), indices, "depth: cross-checks", quiet)
    planes = [_enlarged(plane, width, height) for plane in confirmed]
    for plane, moving in zip(planes, dynamic, strict=True):
        plane[moving] = np.nan
    return planes


def _enlarged(plane: np.ndarray, width: int, height: int) -> Float[np.ndarray, "H W"]:
    """[H, W] the plane at another size, interpolated where all around is known and agrees: on no surface's edge."""
    smooth = cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR)
    nearest = cv2.resize(plane, (width, height), interpolation=cv2.INTER_NEAREST)
    around, unknown = np.ones((3, 3), np.uint8), np.isnan(plane)
    least = cv2.erode(np.where(unknown, np.float32(np.inf), plane), around)
    most = cv2.dilate(np.where(unknown, np.float32(-np.inf), plane), around)
    is_edge = (most / (1.0 + AGREEMENT) > least).astype(np.uint8)
    is_edge = cv2.resize(is_edge, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return np.where(np.isnan(smooth) | is_edge, nearest, smooth)


def _confirmed(frames: PosedFrames, geometry: Sequence[LocalGeometry], frame: int) -> Float[np.ndarray, "H W"]:
    """[H, W] the inverse depth that at least two neighbours confirm, or all where there are fewer."""
    rho, sigma = geometry[frame].inverse_depth, geometry[frame].sigma
    lens, near = frames.lens, frames.neighbours[frame]
    votes = np.zeros(rho.shape, np.uint8)
    for other in near:
        rotation, translation = frames.relative(frame, other)
        rotated = frames.rotated_rays(rotation)
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = rotated[2] + rho * translation[2]
            x, y = (rotated[0] + rho * translation[0]) / depth, (rotated[1] + rho * translation[1]) / depth
            column, row = lens.image(x, y)
            visible = (depth > 1e-3) & (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
            x = np.where(visible, column - 0.5, -9.0).astype(np.float32)
            y = np.where(visible, row - 0.5, -9.0).astype(np.float32)
            theirs, theirs_sigma = (_nearest(p, x, y) for p in (geometry[other].inverse_depth, geometry[other].sigma))
            expected, gain = rho / depth, rotated[2] / depth**2
            tolerance = AGREEMENT * expected + 2.0 * np.hypot(gain * sigma, theirs_sigma)
            votes += visible & (np.abs(theirs - expected) < tolerance)
    return np.where(votes >= min(MIN_CONFIRMATIONS, len(near)), rho, np.float32(np.nan))


def _nearest(plane: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    nothing = (np.nan,) * 4
    return cv2.remap(plane, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nothing)
