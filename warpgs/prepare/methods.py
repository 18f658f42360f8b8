"""What a method for masks or depth provides; the methods themselves are in ``MASKERS`` and ``DEPTHS``."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from .cameras.posed_frames import PosedFrames
from .weights import Network

DynamicMasks = Sequence[Bool[np.ndarray, "H W"]]
Planes = Sequence[Float[np.ndarray, "H W"]]


@dataclass(frozen=True)
class Masker:
    """A method that finds what moves.

    Attributes:
        find: Dynamic masks [H, W] of the frames, from the frames, the folder of the network's weights (None without a
            network), and whether to be quiet.
        network: The network that it needs.
    """

    find: Callable[[PosedFrames, Path | None, bool], DynamicMasks]
    network: Network | None = None


@dataclass(frozen=True)
class DepthMethod:
    """A method that estimates depth.

    Attributes:
        estimate: Inverse depth [H, W] of the frames up to scale and offset, NaN where unknown, from the frames, their
            dynamic masks, the folder of the network's weights (None without a network), and whether to be quiet.
        network: The network that it needs.
    """

    estimate: Callable[[PosedFrames, Iterable[Bool[np.ndarray, "H W"]], Path | None, bool], Planes]
    network: Network | None = None
