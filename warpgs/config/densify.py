"""The options ``--densify.*``."""

from dataclasses import dataclass
from typing import Annotated, Literal

from .bounds import Bounds


@dataclass(frozen=True)
class DensifyConfig:
    """When Gaussians are cloned, split and removed (3DGS, section 5)."""

    strategy: str = "3dgs"
    """Density strategy, a key of DENSITY in warpgs/training/density/__init__.py: clone and split where the gradient on
    screen is large (3dgs), or the sum of the absolute values of its parts, which needs a larger ``gradient``, 8e-4 in
    gsplat (absgrad)."""
    every: Annotated[int, Bounds(min=1)] = 100
    """Iterations between densifications; ``--iterations`` does not rescale it, because it is a sample size."""
    gradient: float = 3e-4
    """Mean screen-space gradient norm above which a Gaussian is cloned or split."""
    unit: Literal["pixel", "extent"] = "pixel"
    """Unit of sizes, which are standard deviations: a pixel of the nearest training view that has shown the Gaussian
    since the last densification, at its depth there; or the radius of the cameras' positions, as in 3DGS (paper).
    Gaussians above 2 pixels, or 0.01 of the extent, are split instead of cloned; above ten times that they are removed
    once opacities have been reset, and ``max_elongation`` holds. Those that no view has shown have any size in pixels.
    With pixel, rates of positions and errors of depth are in view sizes of the capture (docs/glossary.md), and offsets
    of the deformation in halves of it; else all are in scene units."""
    max_elongation: float = 10.0
    """After every ``every`` iterations and at the end, the longest axis of static Gaussians is cut to this many times
    their second longest, or to 20 pixels (0.1 of the extent) if that is longer. 0: never."""
    max_gaussians: int = 3_000_000
    """Maximum number of Gaussians up to which the scene grows: both branches, and all segments of a long video."""
    min_pixels: int = 8
    """Minimum number of training pixels per Gaussian: densification stops where there are fewer, and at three Gaussians
    per pixel of an image. 0: no limit."""
    visibility: float = 3e-4
    """τ: static Gaussians with a lower visibility (paper Eq. 15) are removed."""
    reseed: Annotated[float, Bounds(max=1)] = 0.05
    """Fraction of the training views' dynamic pixels. If at least so many show no dynamic Gaussian, new ones start at
    the next pruning during densification. 0: only if no dynamic Gaussian is left."""
    weakest: Annotated[float, Bounds(max=0.99)] = 0.01
    """Each pruning after the end of densification also removes the Gaussians that contribute least to the training
    views: those that together hold this fraction of all blend weights. 0: none."""

    @property
    def split_size(self) -> float:
        """Size above which a Gaussian is split instead of cloned, in ``unit``."""
        return {"pixel": 2.0, "extent": 0.01}[self.unit]

    @property
    def max_size(self) -> float:
        """Size above which a Gaussian is removed, in ``unit``."""
        return 10.0 * self.split_size
