"""Series of values as small integers: coefficients in a basis that is made for them, in steps.

A series is what a Gaussian has at all key times, or its coefficients of spherical harmonics. The basis has the
principal components of all series of a part: few coefficients differ from zero, and zeros compress to almost nothing.
It is orthonormal, so that an error of a coefficient is an error of the values of the same size (root of the sum of
squares over the series).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

MAX_LEVEL = 1 << 29
"""Largest integer: the difference of two fits in 31 bits."""

BASIS_UNIT = 1e-4
"""Unit of the integers of a basis. Coefficients solve for the rounded basis, so that it adds no error."""

MAX_DEVIATION = 64.0
"""What counts of a value for the basis [steps]: a few values of absurd size must not decide it for all others."""


@dataclass(frozen=True)
class Levels:
    """Quantised coefficients of N series of K values, with C channels.

    Attributes:
        levels: [K, N, C] coefficients in steps.
        steps: [C] step of each channel.
        octaves: [N] the steps of series n are 2 ** octaves[n] times those of the channels.
        basis: [K, K] value t of basis vector k [``BASIS_UNIT``].
    """

    levels: Int32[np.ndarray, "K N C"]
    steps: Float64[np.ndarray, " C"]
    octaves: Int32[np.ndarray, " N"]
    basis: Int32[np.ndarray, "K K"]

    @staticmethod
    def of(
        values: Float64[np.ndarray, "K N C"],
        steps: Float64[np.ndarray, " C"],
        octaves: Int32[np.ndarray, " N"] | None = None,
        over_time: bool = True,
    ) -> "Levels":
        """Quantises values: to within half a step if K = 1.

        Args:
            values: The series.
            steps: Step of each channel, positive.
            octaves: Exponents of the steps; zeros if None.
            over_time: Whether the first basis vector is constant, as for series that hardly change.
        """
        octaves = np.zeros(values.shape[1], np.int32) if octaves is None else octaves
        scaled = values / _all_steps(steps, octaves)
        basis = principal_basis(scaled, over_time)
        coefficients = np.tensordot(np.linalg.inv(basis.T * BASIS_UNIT), scaled, 1)
        levels = np.clip(np.rint(coefficients), -MAX_LEVEL, MAX_LEVEL).astype(np.int32)
        used = (levels != 0).any(axis=(1, 2))[:, None]
        return Levels(levels, steps, octaves, np.where(used, basis, 0))  # zeros take no bytes

    @property
    def values(self) -> Float64[np.ndarray, "K N C"]:
        """The values, up to quantisation."""
        return np.tensordot(self.basis.T * BASIS_UNIT, self.levels, 1) * _all_steps(self.steps, self.octaves)


def principal_basis(series: Float64[np.ndarray, "K N C"], over_time: bool) -> Int32[np.ndarray, "K K"]:
    """The orthonormal basis in which most coefficients are small, that of the largest ones first.

    Args:
        series: Values in steps.
        over_time: Whether the first vector is constant; the others then describe deviations from the mean.
    """
    flat = series.reshape(len(series), series.shape[1] * series.shape[2])
    if over_time:
        flat = flat - flat.mean(0)
    flat = np.clip(flat, -MAX_DEVIATION, MAX_DEVIATION)
    products = flat @ flat.T
    if over_time:
        products += 1.0 + 1e3 * np.trace(products)  # the constant vector has by far the largest eigenvalue
    return np.rint(np.linalg.eigh(products)[1].T[::-1] / BASIS_UNIT).astype(np.int32)


def _all_steps(steps: np.ndarray, octaves: np.ndarray) -> np.ndarray:
    """[N, C] step of each series and channel."""
    return np.exp2(octaves.astype(np.float64))[:, None] * steps
