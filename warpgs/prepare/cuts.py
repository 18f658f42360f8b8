"""Finds the cuts of a video: frames that show something else than the frame before.

Frames are compared as thumbnails of grey levels, by correlation: a jump of exposure does not change it. Between frames
of one shot it stays above 0.7 (11 clips of DAVIS 2016), across cuts it is below 0.3.
"""

from collections import deque

import cv2
import numpy as np
from jaxtyping import Float, UInt8

THUMBNAIL = (48, 27)
"""Width and height of the thumbnails [px]."""

MAX_CORRELATION = 0.5
"""Correlation of two frames below which a cut may be between them."""

MIN_DROP = 0.25
"""By how much the correlation across a cut is below that of the frames before and after it; fast motion has no cut."""

NOISE = 2.0
"""Standard deviation of a grey level; keeps thumbnails without contrast from correlating at random."""


class CutFinder:
    """Finds cuts in frames that are added one by one; keeps four thumbnails only.

    Attributes:
        found: Index and time [s] of the first frame after each cut.
    """

    def __init__(self) -> None:
        self.found: list[tuple[int, float]] = []
        self._recent: deque[tuple[int, float, np.ndarray]] = deque(maxlen=4)

    def add(self, step: int, time: float, grey: UInt8[np.ndarray, "H W"]) -> None:
        """Adds the next frame: its index, its time [s] and its grey levels."""
        small = cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32)
        self._recent.append((step, time, small - small.mean()))
        if len(self._recent) == 4:
            (_, _, a), (_, _, b), (step, time, c), (_, _, d) = self._recent
            across = max(_correlation(b, c), _correlation(b, d))  # one bad frame, or a flash, is no cut
            within = min(_correlation(a, b), _correlation(c, d))
            if across < min(MAX_CORRELATION, within - MIN_DROP):
                self.found.append((step, time))


def _correlation(a: Float[np.ndarray, "h w"], b: Float[np.ndarray, "h w"]) -> float:
    """Correlation of two thumbnails of mean 0."""
    variances = (a * a).mean() + NOISE**2, (b * b).mean() + NOISE**2
    return float((a * b).mean() / np.sqrt(variances[0] * variances[1]))
