"""Tells whether a pixel's surface is still in its position when the camera looks at it again much later.

Between neighbouring frames a slow object looks static: a wrong depth explains its motion. So every frame is compared
with frames far away in time that were taken from similar viewpoints. The far image is warped into the frame by the
depth from the neighbours, optical flow measures the remaining displacement, and depth is solved again from all
positions together: then a static surface whose depth was slightly wrong agrees with most far frames, and one that has
moved agrees with none. Two sets of far frames do that: the farther one also shows slow motion; the nearer one is right
more often, because a camera that passes still sees the same surfaces, and reflections stay where they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..cameras.posed_frames import PosedFrames
from ..cameras.recovered import camera_centers
from ..cameras.triangulation import Observation, errors, fill_unknown, triangulate
from ..frames.flow import Flows

NUM_FAR = 5
"""Number of far frames to compare with, of each set."""

NUM_AGREEING = 3
"""Number of far frames that must agree for a surface to be static; it may be occluded in the others."""

MIN_GAPS = (8, 4)
"""Minimum number of frames between a frame and its far frames, of each set. A hand that moves slowly is lost with 4 and
partly with 6; with 10, a camera that passes shares too little with them (docs/design/motion-masks.md)."""

MIN_SPACING = 3
"""Minimum number of frames between far frames."""

TOLERANCE = 2.0
"""Error of a static surface in a far frame [px]."""

TIE_BREAK = 1e-7
"""Cost of a far frame next to another one [radians]; only a camera on a tripod has viewpoints so equal."""

PATCH = 5
"""Side of the patches that are compared [px]."""

PIXEL_NOISE = 1.5
"""Standard deviation of a grey level; keeps patches without texture from correlating."""


class Agreement(NamedTuple):
    """How far frames agree with a frame.

    Attributes:
        agreement: [H, W] in [0, 1], how well the best of them see the pixel where a static surface would be.
        witnesses: [H, W] number of them whose view contains the pixel's surface.
    """

    agreement: Float[np.ndarray, "H W"]
    witnesses: UInt8[np.ndarray, "H W"]


@dataclass(frozen=True)
class Evidence:
    """Evidence of the neighbours and the far frames on a frame's pixels.

    Attributes:
        residual: [H, W] residual of the neighbours alone [px], see ``LocalGeometry``; NaN where unknown.
        agreements: For each of ``MIN_GAPS``, how far frames at least that far away agree.
        inverse_depth: [H, W] from neighbours and the farthest frames; NaN where unknown.
    """

    residual: Float[np.ndarray, "H W"]
    agreements: tuple[Agreement, ...]
    inverse_depth: Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class _Revisit:
    observation: Observation
    inside: Bool[np.ndarray, "H W"]
    correlation: Float[np.ndarray, "H W"]


class Revisits:
    """Compares frames with far frames."""

    def __init__(self, frames: PosedFrames, flows: Flows) -> None:
        self._frames, self._flows = frames, flows
        self._grey = [cv2.GaussianBlur(plane, (0, 0), 0.7).astype(np.float32) for plane in flows.grey]
        self._centers = camera_centers(frames.poses)

    def far_frames(self, frame: int, inverse_depth: float, min_gap: int) -> list[int]:
        """Frames far away in time that view a scene of this inverse depth from similar viewpoints, best first."""
        poses = self._frames.poses
        cosines = (np.einsum("fij,ij->f", poses[:, :, :3], poses[frame, :, :3]) - 1.0) / 2.0
        distances = np.linalg.norm(self._centers - self._centers[frame], axis=1) * inverse_depth
        cost = np.arccos(np.clip(cosines, -1.0, 1.0)) + distances
        indices = np.arange(len(poses))
        cost[np.abs(indices - frame) < min(min_gap, max(2, len(poses) // 5))] = np.inf
        chosen: list[int] = []
        while len(chosen) < NUM_FAR and np.isfinite(cost).any():
            chosen.append(int(cost.argmin()))
            apart = np.abs(indices - chosen[-1])
            cost += TIE_BREAK * np.exp(-apart / len(poses))  # of equal viewpoints, the farthest in time
            cost[apart < MIN_SPACING] = np.inf
        return chosen

    def evidence(self, frame: int) -> Evidence:
        """The evidence of the neighbours and the far frames on a frame."""
        near = self._frames.observations(frame, self._flows)
        local = triangulate(near, self._frames.focal)
        if self._frames.triangulated is not None:
            self._frames.triangulated[frame] = local
        rho = fill_unknown(local.inverse_depth)
        chosen = [self.far_frames(frame, float(np.median(rho)), gap) for gap in MIN_GAPS]
        revisits = {other: self._revisit(frame, other, rho) for other in sorted(set().union(*chosen))}
        if not revisits:
            nothing = Agreement(np.zeros_like(rho), np.zeros(rho.shape, np.uint8))
            return Evidence(local.residual, (nothing,) * len(MIN_GAPS), local.inverse_depth)
        agreements, solved = zip(*(self._agreement(near, [revisits[k] for k in far]) for far in chosen), strict=True)
        return Evidence(local.residual, agreements, solved[0])

    def _agreement(self, near: Sequence[Observation], far: Sequence[_Revisit]) -> tuple[Agreement, np.ndarray]:
        """How far frames agree with the depth from neighbours and them, and its inverse."""
        focal = self._frames.focal
        solved = triangulate([*near, *(r.observation for r in far)], focal).inverse_depth
        scores = []
        for r in far:
            fit = np.exp(-((errors(r.observation, solved, focal) / TOLERANCE) ** 2))
            scores.append(np.nan_to_num(fit * np.clip((r.correlation - 0.3) / 0.5, 0.0, 1.0) * r.inside))
        best = np.partition(scores, -min(NUM_AGREEING, len(scores)), axis=0)[-NUM_AGREEING:]
        witnesses = np.sum([r.inside for r in far], axis=0).astype(np.uint8)
        return Agreement(best.mean(0).astype(np.float32), witnesses), solved

    def _revisit(self, frame: int, other: int, rho: np.ndarray) -> _Revisit:
        """Warps another frame into this one by its depth and measures the remaining displacement by optical flow."""
        flows, lens = self._flows, self._frames.lens
        rotation, translation = self._frames.relative(frame, other)
        rotated = self._frames.rotated_rays(rotation)
        depth = rotated[2] + rho * translation[2]
        behind = depth < 1e-3
        depth[behind] = 1e-3
        x, y = (rotated[0] + rho * translation[0]) / depth, (rotated[1] + rho * translation[1]) / depth
        column, row = (p.astype(np.float32) - np.float32(0.5) for p in lens.image(x, y))
        inside = (column >= 0) & (column < lens.width - 1) & (row >= 0) & (row < lens.height - 1) & ~behind
        warped = _sample(flows.planes[other], column, row)
        warped = np.where(inside, warped, flows.planes[frame])
        # What remains is smooth and short: at half the size the masks are as good (intersection over union).
        remaining = flows.compute(flows.planes[frame], warped, coarse=True)
        to_column, to_row = flows.x + remaining[..., 0], flows.y + remaining[..., 1]
        position = np.stack([_sample(x, to_column, to_row), _sample(y, to_column, to_row)])
        found = _sample(_sample(self._grey[other], column, row), to_column, to_row)
        correlation = _correlation(self._grey[frame], found)
        visible = inside & (correlation > 0.5)
        return _Revisit(Observation(position, rotated, translation, visible), inside, correlation)


def _sample(plane: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    return cv2.remap(plane, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[H, W] correlation of the patches around every pixel."""
    mean_a, mean_b = cv2.blur(a, (PATCH, PATCH)), cv2.blur(b, (PATCH, PATCH))
    variance_a = np.maximum(cv2.blur(a * a, (PATCH, PATCH)) - mean_a * mean_a, 0.0) + PIXEL_NOISE**2
    variance_b = np.maximum(cv2.blur(b * b, (PATCH, PATCH)) - mean_b * mean_b, 0.0) + PIXEL_NOISE**2
    return (cv2.blur(a * b, (PATCH, PATCH)) - mean_a * mean_b) / np.sqrt(variance_a * variance_b)
