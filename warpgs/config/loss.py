"""The options ``--loss.*``."""

from dataclasses import dataclass
from typing import Annotated, Literal

from .bounds import Bounds


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms (paper Eq. 9, 12, 14, 15), next to those of each image, which are 1."""

    ssim: float = 0.2
    """λ_ssim, the weight of 1 − SSIM next to L1 in every image term."""
    squared: float = 15.0
    """Weight of the squared error of the joint image beside its L1, wherever the joint image is compared; 0 in the
    paper. Large errors vanish sooner and fewer remain."""
    acceleration: float = 0.1
    """Weight of the acceleration of dynamic Gaussians on screen [per pixel per frame²], times the dynamic fraction of
    the image; 0 in the paper. Images say nothing of the times between frames."""
    hidden_appearance: bool = False
    """Whether the joint image also trains how static Gaussians change over time while something dynamic hides them, as
    in the paper. No object is quite opaque, so that what it hides takes its colour."""
    depth: float = 0.5
    """Initial λ_depth, the weight of the static image's depth in the static region (Eq. 14) [view sizes; scene units
    if ``densify.unit`` is extent]."""
    depth_dynamic: float = 4.0
    """Weight of the dynamic image's depth in the dynamic region, relative to λ_depth; 0 in the paper."""
    depth_end: float = 0.2
    """Final λ_depth; it decays exponentially."""
    branches_in_stage2: Literal["yes", "no", "given-masks"] = "given-masks"
    """Whether stage II keeps the terms of the single branches (Eq. 9, 12, 14) beside the joint image, as Eq. 15 does,
    or compares that image alone, as the authors' code does; given-masks: keeps them unless `prepare` made the masks."""
    depth_tolerance: float = 0.03
    """Relative error of a view's aligned depth at the sparse points at which its weight is halved: λ_depth is divided
    by 1 + (error / tolerance)², and depth hardly better than a constant is not used. Errors of the static depth up to 3
    times that of the view are not penalized, because the images determine the geometry better, and aligned depth is
    also multiplied by a smooth factor per view that brings it to the sparse points. 0: equal weights, no margin, no
    factor (paper)."""
    object_depth: bool = True
    """Whether dynamic objects of unknown depth get one by their size, and uncertain depth of objects is averaged with
    that (docs/design/object-depth.md)."""
    mask_margin: Annotated[float, Bounds(max=1)] = 0.008
    """Half width of the band along borders of masks in which the dynamic image is not compared, as a fraction of the
    image's larger side; 0 in the paper. Masks are a few pixels off: a rim of background would be learned as moving."""
