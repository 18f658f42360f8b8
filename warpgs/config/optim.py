"""The options ``--optim.*``."""

from dataclasses import dataclass
from typing import Annotated, Literal

from .bounds import Bounds


@dataclass(frozen=True)
class OptimConfig:
    """Learning rates of Adam: Deformable-3DGS's where the paper prints none, also those that have no option."""

    means: float = 5e-4
    """Positions [view sizes; scene units if ``densify.unit`` is extent]; decays exponentially to 1 %.
    Deformable-3DGS has 1.6e-4 times 5 in scene units; the rate that the paper prints is of its networks."""
    means_anneal: Literal["run", "trained"] = "run"
    """Iterations over which the rate of positions decays: the whole run, or those in which a branch's positions are
    trained: static ones until stage II (paper, section Static Component), dynamic ones from stage I."""
    sh_dc: float = 2.5e-3
    """Spherical harmonics of degree 0."""
    poses: float = 5e-5
    """Initial rate of the corrections of camera poses [rad, and fractions of the view size]; decays exponentially to
    1 %. All frames of a camera that stands still share one; with fewer than 80, proportionally lower. 0: cameras stay
    as the capture has them (paper)."""
    networks: Annotated[float, Bounds(positive=True)] = 8e-4
    """Initial rate of the networks (paper, training protocol)."""
    networks_end: Annotated[float, Bounds(positive=True)] = 1.6e-6
    """Final rate of the networks; it decays exponentially while they are trained."""
