"""Adaptive density control: clone, split, remove (3DGS, section 5), and shorten needles."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.config import DensifyConfig
from warpgs.model.gaussians import Gaussians
from warpgs.ops.adam import Adam

from . import optimizer as optim
from . import ranks

SPLIT_SHRINK = 1.6
"""Factor by which the children of a split are smaller than their parent (3DGS: 0.8 · 2)."""


class GradientStatistics:
    """Mean screen-space gradient norm of each Gaussian over the views in which it was visible.

    Attributes:
        total: [N] sum of the norms.
        count: [N] number of the views.
        screen_offsets: [N, 2] zeros to render each view with; their gradients are what is observed.
    """

    def __init__(self, num: int, device: torch.device) -> None:
        self.total = torch.zeros(num, dtype=torch.float32, device=device)
        self.count = torch.zeros(num, dtype=torch.float32, device=device)
        self.screen_offsets = torch.zeros(num, 2, dtype=torch.float32, device=device, requires_grad=True)

    @torch.no_grad()
    def observe(self, radii: Int32[Tensor, "N 2"]) -> None:
        """Adds one view, after its backward pass.

        Args:
            radii: [N, 2] ``Rendering.radii``; 0 = culled.
        """
        v_offsets, self.screen_offsets.grad = self.screen_offsets.grad, None
        assert v_offsets is not None
        visible = radii[:, 0] > 0
        norms = torch.hypot(*v_offsets.unbind(-1))  # finite where squares would overflow
        self.total += torch.where(visible, norms, 0.0)
        self.count += visible

    @torch.no_grad()
    def merge(self) -> None:
        """Moves what all ranks have observed to rank 0; the others are left with zeros."""
        for tensor in (self.total, self.count):
            ranks.add_(tensor)
            if not ranks.is_first():
                tensor.zero_()

    def mean(self) -> Float[Tensor, " N"]:
        return self.total / self.count.clamp_min(1.0)


class DensifyLimits(NamedTuple):
    """Limits of one densification.

    Attributes:
        extent: Extent of the capture [scene units].
        capacity: Number of Gaussians that may be added; if more exceed the threshold, those with the largest gradients
            grow.
        remove_large: Whether to remove Gaussians larger than ``DensifyConfig.max_size`` of the extent.
    """

    extent: float
    capacity: int
    remove_large: bool


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    optimizer: Adam,
    gradients: Float[Tensor, " N"],
    config: DensifyConfig,
    limits: DensifyLimits,
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
    alive = (gaussians.opacities >= config.min_opacity) & sizes.isfinite() & gaussians.means.isfinite().all(1)
    max_size = config.max_size * limits.extent if limits.remove_large else math.inf
    is_large = sizes > config.dense_fraction * limits.extent
    # As in 3DGS, growth comes first: the children of an oversized Gaussian stay if they are small enough themselves.
    grows = alive & (gradients > config.gradient) & (torch.where(is_large, sizes / SPLIT_SHRINK, sizes) <= max_size)
    if int(grows.sum()) > limits.capacity:
        order = torch.where(grows, gradients, -1.0).argsort(descending=True)
        grows[order[max(limits.capacity, 0) :]] = False
    alive &= sizes <= max_size
    kept = (alive & ~(grows & is_large)).nonzero()[:, 0]
    cloned = (grows & ~is_large).nonzero()[:, 0]
    split = (grows & is_large).nonzero()[:, 0].repeat(2)
    optim.gather(optimizer, gaussians, torch.cat([kept, cloned, split]), num_kept=len(kept))
    if len(split):
        _scatter_children(gaussians, len(kept) + len(cloned), generator)


def _scatter_children(gaussians: Gaussians, first: int, generator: torch.Generator) -> None:
    """Samples the positions of the children of splits, from ``first`` on, from their parents' density; shrinks them."""
    scales = gaussians.scales[first:]
    noise = torch.randn(scales.shape, dtype=torch.float32, generator=generator).to(scales.device) * scales
    quats = torch.nn.functional.normalize(gaussians.quats[first:], dim=1)
    w, axis = quats[:, :1], quats[:, 1:]
    # Rotation of v by a unit quaternion (w, u): v + 2 u × (u × v + w v).
    rotated = noise + 2.0 * torch.linalg.cross(axis, torch.linalg.cross(axis, noise) + w * noise)
    gaussians.means[first:] += rotated
    gaussians.log_scales[first:] = (scales / SPLIT_SHRINK).log()


@torch.no_grad()
def shorten_needles(gaussians: Gaussians, config: DensifyConfig, extent: float) -> None:
    """Shortens the longest axis of large Gaussians to at most ``config.max_elongation`` times the second longest.

    Needles at the border of what the training views show are streaks in views of what lies beyond
    (docs/design/needles.md). Flat Gaussians stay: surfaces need them.

    Args:
        gaussians: Changed in place.
        config: ``max_elongation``, and ``max_size``, up to which a Gaussian may have any shape.
        extent: Extent of the capture [scene units].
    """
    second = gaussians.log_scales.median(1, keepdim=True).values
    longest = (second + math.log(max(config.max_elongation, 1.0))).clamp_min(math.log(config.max_size * extent))
    gaussians.log_scales.clamp_(max=longest)
