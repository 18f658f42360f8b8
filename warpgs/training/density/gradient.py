"""Density control by screen-space gradients (3DGS, section 5): clone, split and remove."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import DensifyConfig
from warpgs.model.gaussians import Gaussians
from warpgs.model.splats import Splats
from warpgs.ops.adam import Adam

from .adaptation import Adaptation
from .operations import MIN_OPACITY, SPLIT_SHRINK, clone, remove, split
from .strategy import Strategy


class Limits(NamedTuple):
    """Limits of one densification.

    Attributes:
        units: [N] what ``DensifyConfig.split_size`` and ``max_size`` are measured in [scene units].
        capacity: Number of Gaussians that may be added; if more exceed the threshold, those with the largest gradients
            grow.
        remove_large: Whether to remove Gaussians larger than ``DensifyConfig.max_size``.
    """

    units: Float[Tensor, " N"]
    capacity: int
    remove_large: bool


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    optimizer: Adam,
    gradients: Float[Tensor, " N"],
    config: DensifyConfig,
    limits: Limits,
    generator: torch.Generator,
) -> None:
    """Clones small and splits large Gaussians with large gradients, then removes transparent and oversized ones.

    Args:
        gaussians: Changed in place, together with the optimizer's moments.
        optimizer: From ``optimizer.make_optimizer``.
        gradients: [N] mean screen-space gradient norms.
        config: Thresholds.
        limits: How many may be added, and what is too large.
        generator: CPU generator that samples the positions of the children of splits.
    """
    sizes = gaussians.scales.max(1).values
    alive = (gaussians.opacities >= MIN_OPACITY) & sizes.isfinite() & gaussians.means.isfinite().all(1)
    max_size = (config.max_size if limits.remove_large else math.inf) * limits.units
    is_large = sizes > config.split_size * limits.units
    # As in 3DGS, growth comes first: the children of an oversized Gaussian stay if they are small enough themselves.
    grows = alive & (gradients > config.gradient) & (torch.where(is_large, sizes / SPLIT_SHRINK, sizes) <= max_size)
    if int(grows.sum()) > limits.capacity:
        order = torch.where(grows, gradients, -1.0).argsort(descending=True)
        grows[order[max(limits.capacity, 0) :]] = False
    stays = grows | (alive & (sizes <= max_size))
    remove(gaussians, optimizer, (~stays).nonzero()[:, 0])
    grows, is_large = grows[stays], is_large[stays]
    clone(gaussians, optimizer, (grows & ~is_large).nonzero()[:, 0])
    split(gaussians, optimizer, (grows & is_large).nonzero()[:, 0], generator)


class GradientStrategy(Strategy):
    """3DGS: Gaussians grow where the mean gradient of their position on screen is large.

    Attributes:
        total: [N] sum of the norms of these gradients over the views that showed the Gaussian.
        count: [N] number of these views.
    """

    def begin(self, num: int, device: torch.device) -> None:
        """Starts with gradients of 0."""
        super().begin(num, device)
        self.total = torch.zeros(num, dtype=torch.float32, device=device)
        self.count = torch.zeros(num, dtype=torch.float32, device=device)
        self.screen_offsets = torch.zeros(num, 2, dtype=torch.float32, device=device, requires_grad=True)

    @torch.no_grad()
    def observe(self, splats: Splats, camera: Camera, radii: Int32[Tensor, "N 2"]) -> None:
        """Adds the gradients of one view, if it was rendered with ``screen_offsets``."""
        super().observe(splats, camera, radii)
        assert self.screen_offsets is not None
        v_offsets, self.screen_offsets.grad = self.screen_offsets.grad, None
        if v_offsets is not None:
            visible = radii[:, 0] > 0
            norms = torch.hypot(*v_offsets.unbind(-1))  # finite where squares would overflow
            self.total += torch.where(visible, norms, 0.0)
            self.count += visible

    def mean(self) -> Float[Tensor, " N"]:
        """Mean norm of the gradients; 0 without a view."""
        return self.total / self.count.clamp_min(1.0)

    def state(self) -> dict[str, Float[Tensor, " N"]]:
        """Also the sums of the gradients, and over how many views."""
        return super().state() | {"total": self.total, "count": self.count}

    def densify(self, at: Adaptation) -> None:
        """Both branches divide the remaining capacity in proportion to how many Gaussians want to grow.

        The dynamic one waits for ``IterationPlan.densifies_dynamic``; its part is left to it until then. Oversized
        Gaussians are removed once opacities have been reset, as in 3DGS.
        """
        config, branches = at.config.densify, (at.scene.static, at.scene.dynamic)
        numbers = [len(gaussians) for gaussians in branches]
        means, units = self.mean().split(numbers), self.units(at).split(numbers)
        generator, capacity = at.generator("densify"), at.capacity
        remove_large = at.plan.done > at.config.schedule.reset_every
        candidates = [int((gradients > config.gradient).sum()) for gradients in means]
        due = [*zip(branches, means, units, candidates, strict=True)][: 1 + at.plan.densifies_dynamic]
        for gaussians, gradients, unit, count in due:
            limits = Limits(unit, capacity * count // max(1, sum(candidates)), remove_large)
            densify(gaussians, at.optimizer, gradients, config, limits, generator)
