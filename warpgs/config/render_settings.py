"""What a render computes."""

import math
from dataclasses import dataclass

from .bounds import Bounds

ALPHA_BOUNDS = Bounds(positive=True, max=0.9998)
"""Range of ``max_alpha``: a Gaussian with an alpha of 0.9999 would end a pixel instead of contributing to it."""


@dataclass(frozen=True)
class RenderSettings:
    """What a render computes in addition to the joint image.

    Attributes:
        branches: Also render the static and the dynamic Gaussians alone, from the same sorted lists.
        depth: Also render depth, as one more channel.
        median: That depth is the median instead of the mean: that of the Gaussian at which the transmittance falls to
            one half, or of the last one where it does not. It has no gradient.
        statistics: Also compute whether and how much each Gaussian contributed to the joint image.
        absgrad: The gradient of ``screen_offsets`` is the sum over the pixels of all images of the absolute values of
            each pixel's contribution, per axis (AbsGS, Ye et al. 2024; gsplat's ``absgrad``).
        antialias: Compensate opacities for the low-pass filter (Mip-Splatting).
        max_alpha: Maximum alpha of a Gaussian in a pixel: 0.999 as in gsplat; 0.99 in 3DGS.
        near: Near plane [scene units].
        max_intersections: Size of the buffers for intersections of Gaussians with tiles; learned if None.
    """

    branches: bool = False
    depth: bool = False
    median: bool = False
    statistics: bool = False
    absgrad: bool = False
    antialias: bool = False
    max_alpha: float = 0.999
    near: float = 0.01
    max_intersections: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.near < math.inf:
            raise ValueError(f"near must be positive and finite, got {self.near}")
        ALPHA_BOUNDS.check("max_alpha", self.max_alpha)
        if self.max_intersections is not None and not 0 < self.max_intersections < 1 << 30:
            raise ValueError(f"max_intersections must be between 1 and 2^30, got {self.max_intersections}")
