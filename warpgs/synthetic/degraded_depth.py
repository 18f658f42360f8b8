"""Exact depth with errors of the kind that a monocular depth network makes."""

import math

import numpy as np
from jaxtyping import Bool, Float, UInt16

DRIFT, FLICKER = 0.08, 0.02
"""Relative errors that change slowly over time, and from frame to frame (standard deviation)."""

SHIFT = 0.10
"""Error of each dynamic object as a whole, as a fraction of the range of inverse depth (maximum)."""

DRIFT_FRAMES = 40
"""Frames over which one field of slow errors becomes the next."""

BLUR = (0.0545, 0.2442, 0.4026, 0.2442, 0.0545)
"""Weights of a Gaussian of σ = 1 px, for edges."""


class DegradedDepth:
    """Errors of a sequence of frames; always the same ones, and the same bits on every machine."""

    def __init__(self, num_frames: int) -> None:
        random = np.random.default_rng(0)
        self._slow = [_waves(random, 4) for _ in range(2 + num_frames // DRIFT_FRAMES)]
        self._fast = [_waves(random, 3) for _ in range(num_frames)]
        self._shifts = [0.0]
        for _ in range(num_frames):
            self._shifts.append(0.97 * self._shifts[-1] + 0.25 * float(random.standard_normal()))

    def __call__(
        self, k: int, inverse: Float[np.ndarray, "H W"], dynamic: Bool[np.ndarray, "H W"]
    ) -> UInt16[np.ndarray, "H W"]:
        """Inverse depth of frame ``k`` with errors, as 16 bits.

        ``inverse`` is exact, up to scale and offset, in [0, 65535].
        """
        index, fraction = divmod(k / DRIFT_FRAMES, 1.0)
        slow = (1.0 - fraction) * self._slow[int(index)] + fraction * self._slow[int(index) + 1]
        error = DRIFT * _field(slow, inverse.shape) + FLICKER * _field(self._fast[k], inverse.shape)
        ordered = np.sort(inverse, axis=None)
        spread = ordered[int(0.95 * (len(ordered) - 1))] - ordered[int(0.05 * (len(ordered) - 1))]
        worse = inverse * (1.0 + error) + SHIFT * spread * math.tanh(self._shifts[k + 1]) * dynamic
        return _blurred(_blurred(worse, 0), 1).clip(0, 65535).round().astype(np.uint16)


def _waves(random: np.random.Generator, count: int) -> Float[np.ndarray, "N N"]:
    """Random amplitudes of cosines along both axes, of unit variance together, without the constant one."""
    amplitudes = random.standard_normal((count, count))
    amplitudes[0, 0] = 0.0
    energy = amplitudes**2 * np.array([1.0] + [0.5] * (count - 1)) * np.array([[1.0]] + [[0.5]] * (count - 1))
    return amplitudes / math.sqrt(energy.sum())


def _field(amplitudes: Float[np.ndarray, "N N"], shape: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    """A smooth field of unit standard deviation over an image."""
    rows, columns = (
        np.cos(np.pi * np.arange(len(amplitudes))[:, None] * (np.arange(size) + 0.5) / size) for size in shape
    )
    return rows.T @ amplitudes @ columns


def _blurred(values: Float[np.ndarray, "H W"], axis: int) -> Float[np.ndarray, "H W"]:
    """Blurred along an axis; the border is continued."""
    reach, size = len(BLUR) // 2, values.shape[axis]
    at = np.arange(size)
    parts = [w * values.take((at + k - reach).clip(0, size - 1), axis) for k, w in enumerate(BLUR)]
    return np.sum(parts, axis=0)
