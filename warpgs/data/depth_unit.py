"""Finds the unit of depth from cameras and images alone: in the right one, a view shows what the next one sees."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .capture import Frame

FACTORS = np.geomspace(1e-4, 1e4, 121)
"""Factors that are tried; 1 is one of them."""

NUM_PIXELS, MIN_PIXELS = 500, 50
"""Pixels of a view that are followed into the next one, and the minimum number for a correlation."""

TOLERANCE = 0.05
"""Relative difference of the depths of one point in two views that agree."""

MIN_AGREEMENT, MIN_GAIN = 0.3, 1.5
"""Agreement at the best factor, and how many times that at a factor of 1 it must be, for the unit to be wrong."""

MIN_GAIN_OF_INVERSE = 1.15
"""The same of the inverse of depth over depth in its best unit, for files to hold inverse depth: 0.82 over 0.63 for
boards at 3 to 6 units, and the other way round if they hold depth."""

MAX_FACTOR = 1.3
"""Factors that are nearer to 1 are rounding, not another unit."""


class UnitFit(NamedTuple):
    """How well views agree.

    Attributes:
        factor: The factor of depth at which they agree best.
        best: Their agreement then: the fraction of pixels with one depth in both, times the correlation of their grey.
        given: Their agreement at a factor of 1.
    """

    factor: float
    best: float
    given: float

    @property
    def is_wrong(self) -> bool:
        """Whether the views agree much better in another unit."""
        is_other = max(self.factor, 1.0 / self.factor) > MAX_FACTOR
        return is_other and self.best >= MIN_AGREEMENT and self.best > MIN_GAIN * self.given

    def is_beaten_by(self, inverse: "UnitFit") -> bool:
        """Whether views agree better if files hold inverse depth."""
        return inverse.best >= MIN_AGREEMENT and inverse.best > MIN_GAIN_OF_INVERSE * self.best


def fit_unit(frames: Sequence[Frame], is_inverted: bool = False) -> UnitFit:
    """The factor of depth at which each frame agrees best with the next one.

    Args:
        frames: In the order of time, with depth, in which the cameras move; of a single one, nothing is said.
        is_inverted: Whether to take the inverse of the depth, in any unit, instead of the depth.
    """
    pairs = list(itertools.pairwise(frames))
    if not pairs:
        return UnitFit(1.0, 0.0, 0.0)
    scale = 1.0
    if is_inverted:
        shifts = [float((first.camera.position - second.camera.position).norm()) for first, second in pairs]
        scale = float(np.median(shifts)) / max(float(np.median([_median(_depth(f, True)) for f in frames])), 1e-30)
    agreement = np.mean([_agreement(*pair, scale * FACTORS, is_inverted) for pair in pairs], axis=0)
    best = int(agreement.argmax())
    return UnitFit(float(FACTORS[best]), float(agreement[best]), float(agreement[len(FACTORS) // 2]))


def _median(depth: Float[np.ndarray, "H W"]) -> float:
    return float(np.nanmedian(depth)) if np.isfinite(depth).any() else 0.0


def _depth(frame: Frame, is_inverted: bool) -> Float[np.ndarray, "H W"]:
    """Depth, or if that is to be inverted, inverse depth; NaN where unknown or dynamic."""
    assert frame.inverse_depth is not None
    inverse = frame.inverse_depth.double().numpy()
    known = inverse > 0
    if frame.static_mask is not None:
        known &= frame.static_mask.numpy()
    return np.where(known, inverse if is_inverted else 1.0 / np.where(known, inverse, 1.0), np.nan)


def _agreement(
    first: Frame, second: Frame, factors: Float[np.ndarray, " S"], is_inverted: bool
) -> Float[np.ndarray, " S"]:
    """Agreement of two views at every factor of their depth."""
    depths = [_depth(frame, is_inverted) for frame in (first, second)]
    rows, columns = np.nonzero(np.isfinite(depths[0]))
    if len(rows) < MIN_PIXELS:
        return np.zeros(len(factors))
    chosen = np.random.default_rng(0).permutation(len(rows))[:NUM_PIXELS]
    rows, columns = rows[chosen], columns[chosen]
    start, along = _line_of_sight(first, second, rows, columns, depths[0][rows, columns])
    seen = start[:, None] + factors[:, None] * along[:, None]  # [3, S, N]
    pixels, depth, is_seen = (
        part.numpy().T.reshape(*part.shape[1:], *seen.shape[1:])
        for part in second.camera.place(torch.from_numpy(seen.reshape(3, -1).T))
    )
    height, width = depths[1].shape
    inside = is_seen & (pixels[0] >= 0) & (pixels[0] < width) & (pixels[1] >= 0) & (pixels[1] < height)
    column, row = np.where(inside, pixels, 0.0).astype(int)
    with np.errstate(invalid="ignore"):
        agrees = inside & (np.abs(depth / (factors[:, None] * depths[1][row, column]) - 1.0) < TOLERANCE)
    a, b = _grey(first)[rows, columns], _grey(second)[row, column]
    return _correlations(a, b, agrees) * agrees.mean(1)


def _line_of_sight(
    first: Frame, second: Frame, rows: np.ndarray, columns: np.ndarray, depth: Float[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, "3 1"], Float[np.ndarray, "3 N"]]:
    """The second camera sees the pixels of the first at start + factor · along, in its own axes."""
    r1, r2 = (_double(frame.camera.viewmat[:3, :3]) for frame in (first, second))
    rays = first.camera.rays(torch.from_numpy(np.stack([columns, rows], 1) + 0.5)).numpy()
    shift = _double(first.camera.position - second.camera.position)
    return r2 @ shift[:, None], r2 @ r1.T @ (rays.T * depth)


def _double(values: Tensor) -> np.ndarray:
    return values.double().numpy()


def _grey(frame: Frame) -> Float[np.ndarray, "H W"]:
    return cv2.cvtColor(frame.image.numpy(), cv2.COLOR_RGB2GRAY).astype(np.float64)


def _correlations(
    a: Float[np.ndarray, " N"], b: Float[np.ndarray, "S N"], chosen: Bool[np.ndarray, "S N"]
) -> Float[np.ndarray, " S"]:
    """Correlations of the chosen samples of a and b, at least 0; 0 if they are few or without contrast."""
    count, of_b = np.maximum(chosen.sum(1), 1), np.where(chosen, b, 0.0)
    mean_a, mean_b = chosen @ a / count, of_b.sum(1) / count
    variance_a = chosen @ a**2 / count - mean_a**2
    variance_b = (of_b**2).sum(1) / count - mean_b**2
    is_usable = (chosen.sum(1) >= MIN_PIXELS) & (variance_a >= 1.0) & (variance_b >= 1.0)
    scale = np.sqrt(np.where(is_usable, variance_a * variance_b, 1.0))
    return np.where(is_usable, np.maximum(0.0, (of_b @ a / count - mean_a * mean_b) / scale), 0.0)
