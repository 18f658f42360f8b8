"""Every default, in one place."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RenderSettings:
    """What a render computes besides the joint image.

    Attributes:
        branches: Also the images of the static and of the dynamic Gaussians alone, from the same pass.
        depth: Also depth, as one more channel.
        statistics: Also whether and how much each Gaussian contributed to the joint image.
        absgrad: On the way back, also the absolute-value variant of the screen-space gradient norms.
        antialias: Opacity compensation for the low-pass filter (Mip-Splatting).
        near: Near plane [scene units].
    """

    branches: bool = False
    depth: bool = False
    statistics: bool = False
    absgrad: bool = False
    antialias: bool = False
    near: float = 0.01
