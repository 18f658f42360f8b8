"""The methods that estimate depth."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from ..cameras.posed_frames import PosedFrames
from ..weights import DEPTH_ANYTHING
from .estimate import DepthMethod, Planes
from .flow import static_depth


def _anything(
    frames: PosedFrames, dynamic: Iterable[Bool[np.ndarray, "H W"]], weights: Path | None, quiet: bool
) -> Planes:
    from .anything import predict  # imports torch

    assert weights is not None
    return predict(frames.images, weights, quiet)


DEPTHS: dict[str, DepthMethod | None] = {
    "flow": DepthMethod(lambda frames, dynamic, weights, quiet: static_depth(frames, list(dynamic), quiet), None, True),
    "anything": DepthMethod(_anything, DEPTH_ANYTHING),
    "none": None,
}
"""Values of ``--depth``. A new method is a new file and a line here."""
