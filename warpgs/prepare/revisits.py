"""Does a pixel's surface stand where it stood when the camera looks again much later?

Over neighbouring frames a slow body looks static: its motion is absorbed by a wrong depth. So every frame is compared
with frames far off in time that were taken from similar places. The other picture is drawn into the frame as the depth
from the neighbours explains it, optical flow measures what is left, and depth is solved anew from all places together:
a static surface whose depth was a little wrong agrees then with most of the far frames, a moved one with none.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from .dense import Observation, PosedFrames, errors, filled, triangulate

NUM_FAR = 6
"""Far frames to compare with."""

NUM_AGREEING = 3
"""So many must agree for a surface to be static; the others may be occluded."""

GAP = 10
"""Frames between a frame and far ones."""

SPREAD = 3
"""Frames between far frames."""

TOLERANCE = 2.0
"""Error of a static surface in a far frame [px]."""

PATCH = 9
"""Side of the patches that are compared [px]."""

PIXEL_NOISE = 1.5
"""Standard deviation of a grey level, which keeps patches without texture from correlating."""


@dataclass(frozen=True)
class Evidence:
    """What far frames say of a frame's pixels.

    Attributes:
        residual: [H, W] of the neighbours alone [px], see ``LocalGeometry``; NaN where unknown.
        agreement: [H, W] in [0, 1], how well the best far frames see the pixel where a static surface would be.
        witnesses: [H, W] how many far frames look at its place.
        inverse_depth: [H, W] from near and far frames; NaN where unknown.
    """

    residual: Float[np.ndarray, "H W"]
    agreement: Float[np.ndarray, "H W"]
    witnesses: UInt8[np.ndarray, "H W"]
    inverse_depth: Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class _Revisit:
    observation: Observation
    inside: Bool[np.ndarray, "H W"]
    correlation: Float[np.ndarray, "H W"]


class Revisits:
    """Compares frames with far ones.

    Attributes:
        footage: The frames.
    """

    def __init__(self, footage: PosedFrames, grey: list[UInt8[np.ndarray, "H W"]]) -> None:
        """Takes the grey picture of every frame of the footage."""
        self.footage = footage
        self._grey = [cv2.GaussianBlur(plane, (0, 0), 1.0).astype(np.float32) for plane in grey]
        poses = footage.poses
        self._centers = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])

    def far_frames(self, frame: int, inverse_depth: float) -> list[int]:
        """Frames far off in time that look at a scene of this inverse depth from similar places, best first."""
        poses = self.footage.poses
        cosines = (np.einsum("fij,ij->f", poses[:, :, :3], poses[frame, :, :3]) - 1.0) / 2.0
        moved = np.linalg.norm(self._centers - self._centers[frame], axis=1) * inverse_depth
        cost = np.arccos(np.clip(cosines, -1.0, 1.0)) + moved
        steps = np.arange(len(poses))
        cost[np.abs(steps - frame) < min(GAP, max(2, len(poses) // 5))] = np.inf
        chosen: list[int] = []
        while len(chosen) < NUM_FAR and np.isfinite(cost).any():
            chosen.append(int(cost.argmin()))
            cost[np.abs(steps - chosen[-1]) < SPREAD] = np.inf
        return chosen

    def evidence(self, frame: int) -> Evidence:
        """What the neighbours and the far frames say of a frame."""
        focal = self.footage.lens.focal[0]
        near = self.footage.observations(frame)
        local = triangulate(near, focal)
        rho = filled(local.inverse_depth)
        revisits = [self._revisit(frame, other, rho) for other in self.far_frames(frame, float(np.median(rho)))]
        if not revisits:
            nothing = np.zeros_like(rho)
            return Evidence(local.residual, nothing, nothing.astype(np.uint8), local.inverse_depth)
        solved = triangulate([*near, *(r.observation for r in revisits)], focal).inverse_depth
        scores = []
        for r in revisits:
            fit = np.exp(-((errors(r.observation, solved, focal) / TOLERANCE) ** 2))
            scores.append(np.nan_to_num(fit * np.clip((r.correlation - 0.3) / 0.5, 0.0, 1.0) * r.inside))
        best = np.partition(scores, -min(NUM_AGREEING, len(scores)), axis=0)[-NUM_AGREEING:]
        witnesses = np.sum([r.inside for r in revisits], axis=0).astype(np.uint8)
        return Evidence(local.residual, best.mean(0).astype(np.float32), witnesses, solved)

    def _revisit(self, frame: int, other: int, rho: np.ndarray) -> _Revisit:
        """Draws another frame into this one by its depth, and measures what is left by optical flow."""
        footage, lens = self.footage, self.footage.lens
        rotation, shift = footage.relative(frame, other)
        turned = footage.turned(rotation)
        depth = turned[2] + rho * shift[2]
        behind = depth < 1e-3
        depth[behind] = 1e-3
        x, y = (turned[0] + rho * shift[0]) / depth, (turned[1] + rho * shift[1]) / depth
        column, row = (p.astype(np.float32) - np.float32(0.5) for p in lens.image(x, y))
        inside = (column >= 0) & (column < lens.width - 1) & (row >= 0) & (row < lens.height - 1) & ~behind
        drawn = _sample(footage.flows.planes[other], column, row)
        drawn = np.where(inside, drawn, footage.flows.planes[frame])
        left = footage.flows.between(footage.flows.planes[frame], drawn)
        to_column, to_row = footage.flows.x + left[..., 0], footage.flows.y + left[..., 1]
        place = np.stack([_sample(x, to_column, to_row), _sample(y, to_column, to_row)])
        found = _sample(_sample(self._grey[other], column, row), to_column, to_row)
        correlation = _correlation(self._grey[frame], found)
        return _Revisit(Observation(place, turned, shift, inside & (correlation > 0.5)), inside, correlation)


def _sample(plane: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    return cv2.remap(plane, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation of the patches around every pixel."""
    mean_a, mean_b = cv2.blur(a, (PATCH, PATCH)), cv2.blur(b, (PATCH, PATCH))
    variance_a = np.maximum(cv2.blur(a * a, (PATCH, PATCH)) - mean_a * mean_a, 0.0) + PIXEL_NOISE**2
    variance_b = np.maximum(cv2.blur(b * b, (PATCH, PATCH)) - mean_b * mean_b, 0.0) + PIXEL_NOISE**2
    return (cv2.blur(a * b, (PATCH, PATCH)) - mean_a * mean_b) / np.sqrt(variance_a * variance_b)
