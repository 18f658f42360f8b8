"""Recognises a camera that only turns: one rotation per pair of frames explains how all pixels move.

Without parallax depth is undetermined, whatever a reconstruction says. With the ray r = K⁻¹ (u, v, 1) of a pixel, a
camera that turns by R moves the pixel to K R r. R is estimated from matches by iteratively reweighted Procrustes
alignment of unit rays, so that a minority of dynamic matches does not count. An unknown focal length is the one of a
few that explains most.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .lens import Lens

TOLERANCE = 0.002
"""Distance of a match from where the rotation moves it that counts as explained, relative to the longer side."""

MIN_EXPLAINED = 0.8
"""Fraction of the matches of a pair that are explained if the camera only turns."""

MAX_WORSE_PAIRS = 0.2
"""Fraction of the pairs that may be explained worse."""

MIN_MATCHES, MIN_PAIRS, MAX_PAIRS = 50, 8, 40
"""Minimum number of matches of a pair and of pairs, and maximum number of pairs that are examined."""

MIN_DISPLACEMENT = 0.005
"""Median displacement of the widest pairs, relative to the longer side, below which the camera stands still."""

FOCALS, FINE_FOCALS = np.geomspace(0.4, 5.0, 12), np.geomspace(0.85, 1.18, 7)
"""Focal lengths that are tried, relative to the longer side, and then relative to the best of these."""

NUM_REWEIGHTINGS = 6

Matches = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]
"""[M, 2] positions of the same points in two frames [px from the image's corner]."""


@dataclass(frozen=True)
class Turning:
    """How well turning alone explains the pairs of frames.

    Attributes:
        explained: Fraction of the matches that a rotation explains, in the pair at the ``MAX_WORSE_PAIRS`` quantile.
        displacement: Median displacement in the examined pairs, relative to the longer side.
        focal: Focal length that explains most, or that was known [px].
    """

    explained: float
    displacement: float
    focal: float

    @property
    def stands_still(self) -> bool:
        """Whether nothing shows that the camera moves at all."""
        return self.displacement < MIN_DISPLACEMENT

    @property
    def only_turns(self) -> bool:
        """Whether the camera turns without changing its position."""
        return not self.stands_still and self.explained >= MIN_EXPLAINED


def find_turning(pairs: Sequence[Matches], size: tuple[int, int], focal: float | None = None) -> Turning | None:
    """How well turning explains the widest pairs of frames; None if too few pairs have enough matches.

    Args:
        pairs: Matches of pairs of frames, inliers of an epipolar geometry.
        size: (width, height) of the frames [px].
        focal: Focal length [px]; None if unknown.
    """
    longest = max(size)
    usable = [(a, b) for a, b in pairs if len(a) >= MIN_MATCHES]
    if len(usable) < MIN_PAIRS:
        return None
    wide = sorted(usable, key=_displacement, reverse=True)[: max(MIN_PAIRS, min(len(usable) // 3, MAX_PAIRS))]
    displacement = float(np.median([_displacement(pair) for pair in wide])) / longest
    tolerance = TOLERANCE * longest

    def explained(focal: float, pairs: Sequence[Matches]) -> float:
        lens = Lens.centered(focal, size)
        return float(np.quantile([_explained(pair, lens, tolerance) for pair in pairs], MAX_WORSE_PAIRS))

    if focal is None:
        coarse = max(FOCALS * longest, key=lambda f: explained(f, wide[::3]))
        focal = max(coarse * FINE_FOCALS, key=lambda f: explained(f, wide[::3]))
    return Turning(explained(focal, wide), displacement, float(focal))


def _displacement(pair: Matches) -> float:
    return float(np.median(np.linalg.norm(pair[0] - pair[1], axis=1)))


def _explained(pair: Matches, lens: Lens, tolerance: float) -> float:
    """Fraction of the matches that the best rotation explains, up to a distance [px]."""
    tolerance /= lens.focal[0]
    _, errors = fit_rotation(lens.unit_rays(pair[0]), lens.unit_rays(pair[1]), tolerance)
    return float((errors < tolerance).mean())


def fit_rotation(
    a: Float[np.ndarray, "M 3"], b: Float[np.ndarray, "M 3"], tolerance: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " M"]]:
    """The rotation that takes most unit rays a to b, and the distance of each on the plane z = 1.

    Args:
        a, b: [M, 3] the same static points in two frames.
        tolerance: Distance at which the weight of a match is a quarter.
    """
    weights, there = np.ones(len(a)), b[:, :2] / np.maximum(b[:, 2:], 1e-6)
    for _ in range(NUM_REWEIGHTINGS):
        u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turned = a @ rotation.T
        errors = np.linalg.norm(turned[:, :2] / np.maximum(turned[:, 2:], 1e-6) - there, axis=1)  # no ray at 90°
        weights = 1.0 / (1.0 + (errors / tolerance) ** 2) ** 2
    return rotation, errors
