"""Growth of a set of Gaussians: clone, split, remove, reset (3DGS, section 5)."""

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.config import DensifyConfig
from warpgs.model.gaussians import Gaussians
from warpgs.ops.adam import Adam

from . import optimizer as optim

RESET_OPACITY = 0.01
SPLIT_SHRINK = 1.6
"""Children of a split are smaller by this (3DGS: 0.8 · 2)."""


class GradientStatistics:
    """Mean screen-space gradient norm of each Gaussian over the views that saw it since the last densification.

    Attributes:
        total: [N] sum of norms.
        count: [N] number of views.
    """

    def __init__(self, num: int, device: torch.device) -> None:
        self.total = torch.zeros(num, device=device)
        self.count = torch.zeros(num, device=device)

    @torch.no_grad()
    def observe(self, norms: Float[Tensor, "N 2"], radii: Int32[Tensor, "N 2"]) -> None:
        """Adds one view; call after its backward pass."""
        visible = radii[:, 0] > 0
        self.total += torch.where(visible, norms[:, 0], 0.0)
        self.count += visible

    def mean(self) -> Float[Tensor, " N"]:
        return self.total / self.count.clamp_min(1.0)


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    optimizer: Adam,
    gradients: Float[Tensor, " N"],
    extent: float,
    config: DensifyConfig,
    room: int,
    remove_large: bool,
    generator: torch.Generator,
) -> None:
    """Clones small and splits large Gaussians of large gradients, and removes faint and oversized ones.

    Args:
        gaussians: Changed in place, the optimizer's moments with it.
        optimizer: From ``optim.make_optimizer``.
        gradients: [N] mean screen-space gradient norms.
        extent: Of the capture [scene units].
        config: Thresholds.
        room: Gaussians that may be added; if more want to grow, those of the largest gradients do.
        remove_large: Whether to remove Gaussians larger than ``config.max_size`` of the extent.
        generator: On the CPU; draws the places of the children of splits.
    """
    sizes = gaussians.scales.max(1).values
    alive = (gaussians.opacities >= config.min_opacity) & sizes.isfinite() & gaussians.means.isfinite().all(1)
    if remove_large:
        alive &= sizes <= config.max_size * extent
    wanted = alive & (gradients > config.gradient)
    if int(wanted.sum()) > room:
        order = torch.where(wanted, gradients, -1.0).argsort(descending=True)
        wanted[order[max(room, 0) :]] = False
    is_large = sizes > config.dense_fraction * extent
    kept = (alive & ~(wanted & is_large)).nonzero()[:, 0]
    cloned = (wanted & ~is_large).nonzero()[:, 0]
    split = (wanted & is_large).nonzero()[:, 0].repeat(2)
    optim.gather(optimizer, gaussians, torch.cat([kept, cloned, split]), num_kept=len(kept))
    if len(split):
        _scatter_children(gaussians, len(kept) + len(cloned), generator)


def _scatter_children(gaussians: Gaussians, first: int, generator: torch.Generator) -> None:
    """Draws the children of splits, from ``first`` on, from their parents' own density and shrinks them."""
    scales = gaussians.scales[first:]
    noise = torch.randn(scales.shape, generator=generator).to(scales.device) * scales
    quats = torch.nn.functional.normalize(gaussians.quats[first:], dim=1)
    w, axis = quats[:, :1], quats[:, 1:]
    # Rotation of v by a unit quaternion (w, u): v + 2 u × (u × v + w v).
    turned = noise + 2.0 * torch.linalg.cross(axis, torch.linalg.cross(axis, noise) + w * noise)
    gaussians.means[first:] += turned
    gaussians.log_scales[first:] = (scales / SPLIT_SHRINK).log()


@torch.no_grad()
def reset_opacities(gaussians: Gaussians, optimizer: Adam) -> None:
    """Lowers all opacities to at most 0.01, so that what is not needed can be removed (3DGS)."""
    highest = torch.logit(torch.tensor(RESET_OPACITY)).item()
    gaussians.logit_opacities.clamp_(max=highest)
    optim.forget(optimizer, gaussians.logit_opacities)
