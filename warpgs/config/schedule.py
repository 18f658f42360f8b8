"""The options ``--schedule.*``."""

from dataclasses import dataclass
from typing import Annotated

from .bounds import Bounds


@dataclass(frozen=True)
class Schedule:
    """Everything that is counted in iterations; ``--iterations`` rescales all of it but ``fit_motion`` and ``warmup``.

    Except for the lengths of the stages, iterations count from the start of stage I.
    """

    pretrain: int = 400
    """Length of the depth-aware pretraining; in its middle, monocular depth is aligned again, to the rendered depth."""
    stage1: int = 7_500
    """Length of stage I, in which each branch has its own losses."""
    stage2: int = 37_500
    """Length of stage II, the joint optimization."""
    densify_from: int = 100
    """Iteration from which Gaussians are densified."""
    densify_until: int = 4_500
    """Iteration until which Gaussians are densified."""
    reset_every: Annotated[int, Bounds(min=1)] = 1_100
    """Iterations between opacity resets during densification; rescaling shortens it to 100 at least."""
    prune_every: Annotated[int, Bounds(min=1)] = 1_500
    """Iterations between visibility-driven prunings, in stage I."""
    fit_motion: int = 2_000
    """Steps that fit the deformation to dynamic points of known depth before stage I; 0: none (paper)."""
    deform_from: int = 400
    """Iteration from which dynamic Gaussians are deformed; 0 where the deformation was fitted to points."""
    appearance_from: int | None = 0
    """Iteration from which the appearance network changes static Gaussians; in stage II alone if None (paper, section
    Training Protocol). By then moving shadows have become Gaussians at wrong depths (docs/method.md)."""
    joint_from: int | None = 0
    """Iteration of stage I from which the joint image is compared; in stage II alone if None (paper)."""
    warmup: int = 400
    """Iterations over which a network's learning rate rises once it is in use, whatever the length of the run. With the
    full rate, Adam's first steps would leave ReLU units inactive forever and move the Gaussians of an object away."""
    noise_until: int = 3_750
    """Iteration at which the noise on time has decayed to 0."""
    settle: int = 7_500
    """Number of iterations at the end of the run in which no Gaussians are omitted (``model.dropout``), and in which
    the learning rates of rotations, scales, opacities and colours decay to a tenth; 0: none (paper)."""
    sh_degree_every: Annotated[int, Bounds(min=1)] = 400
    """Iterations between increments of the degree of spherical harmonics, from 0 to ``model.sh_degree``."""

    @property
    def num_iterations(self) -> int:
        """Iterations of the whole run."""
        return self.pretrain + self.stage1 + self.stage2
