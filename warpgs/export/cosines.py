"""Values over time as small integers: the coefficients of a discrete cosine transform, in steps.

What changes smoothly has few coefficients that differ from zero, and zeros compress to almost nothing. The transform is
orthonormal, so that an error of a coefficient is an error of the values of the same size (root of the sum of squares
over time).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32
from scipy import fft

ROUND_UP = 1 / 3
"""Part of a step added to coefficients over time before rounding down: less than one half, because zeros cost least."""

MAX_LEVEL = 1 << 29
"""Largest integer: the difference of two fits in 31 bits."""


@dataclass(frozen=True)
class Levels:
    """Quantised cosine coefficients of N series of K values, with C channels.

    Attributes:
        levels: [K, N, C] coefficients in steps, the lowest frequency first.
        steps: [C] step of each channel.
    """

    levels: Int32[np.ndarray, "K N C"]
    steps: Float64[np.ndarray, " C"]

    @staticmethod
    def of(values: Float64[np.ndarray, "K N C"], steps: Float64[np.ndarray, " C"]) -> "Levels":
        """Quantises values: to within half a step if K = 1."""
        coefficients = fft.dct(values, axis=0, norm="ortho") / steps
        added = np.full((len(values), 1, 1), ROUND_UP)
        added[:1] = 0.5
        levels = np.copysign(np.floor(np.abs(coefficients) + added), coefficients)
        return Levels(np.clip(levels, -MAX_LEVEL, MAX_LEVEL).astype(np.int32), steps)

    @property
    def values(self) -> Float64[np.ndarray, "K N C"]:
        """The values, up to quantisation."""
        return fft.idct(self.levels * self.steps, axis=0, norm="ortho")
