"""Density control by sampling: 3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024, MCMC).

Gaussians are samples of a distribution. A step of Adam with noise on positions draws from it (Eq. 8). Dead Gaussians go
where others are, and their number grows by a fixed fraction; neither changes the distribution (Eq. 9).
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import DensifyConfig
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam

from .adaptation import Adaptation
from .operations import MIN_OPACITY, rotated
from .relocation import respawn
from .strategy import Strategy

GROWTH = 0.05
"""Fraction by which the number of Gaussians grows in a densification, up to the maximum."""

GATE_STEEPNESS, GATE_OPACITY = 100.0, 0.005
"""k and t of the factor σ(−k (o − t)) of the noise at an opacity of o, as in the code of the paper's authors."""


@torch.no_grad()
def add_noise(gaussians: Gaussians, normal: Float[Tensor, "N 3"], factor: Float[Tensor, ""]) -> None:
    """Adds noise σ(−k (o − t)) Σ η to positions, which moves transparent Gaussians along their longest axes.

    Args:
        gaussians: Changed in place.
        normal: [N, 3] η, standard normal random numbers.
        factor: Of the noise.
    """
    gate = torch.sigmoid(GATE_STEEPNESS * (GATE_OPACITY - gaussians.opacities))
    conjugates = torch.cat([gaussians.quats[:, :1], -gaussians.quats[:, 1:]], 1)
    along_axes = rotated(normal, conjugates) * gaussians.scales.square()
    gaussians.means.add_(factor * gate[:, None] * rotated(along_axes, gaussians.quats))


class McmcStrategy(Strategy):
    """Relocates dead Gaussians, grows by ``GROWTH`` and adds noise to positions; opacities are not reset."""

    def __init__(self, config: DensifyConfig) -> None:
        super().__init__(config)
        del self.actions["reset"]

    def densify(self, at: Adaptation) -> None:
        """In both branches, which divide the remaining capacity in proportion to their numbers."""
        branches = (at.scene.static, at.scene.dynamic)
        generator, capacity, num = at.generator("densify"), max(0, at.capacity), sum(map(len, branches))
        for gaussians in branches:
            is_finite = gaussians.log_scales.isfinite().all(1) & gaussians.means.isfinite().all(1)
            is_dead = ~((gaussians.opacities > MIN_OPACITY) & is_finite)
            added = min(int(GROWTH * len(gaussians)), capacity * len(gaussians) // max(1, num))
            respawn(gaussians, at.optimizer, is_dead, added, MIN_OPACITY, generator)

    def after_step(
        self, scene: SplitScene, optimizer: Adam, unit: float, generator: Callable[[str, torch.device], torch.Generator]
    ) -> None:
        """Adds noise to the positions that are trained, in proportion to their learning rate and covariance.

        The covariance is in unit²: a learning rate is a length, and noise grows like one with the scene.
        """
        rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
        random = generator("noise", scene.static.means.device)
        for branch, gaussians in (("static", scene.static), ("dynamic", scene.dynamic)):
            means = gaussians.means
            normal = torch.randn(means.shape, dtype=means.dtype, device=means.device, generator=random)
            if means.requires_grad:
                add_noise(gaussians, normal, self.config.noise * rates[f"{branch}.means"] / unit**2)
