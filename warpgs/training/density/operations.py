"""Changes of a set of Gaussians that strategies share; the optimizer's moments follow them."""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from warpgs.model.gaussians import Gaussians
from warpgs.ops.adam import Adam
from warpgs.training.optimizer import MOMENTS

MIN_OPACITY = 0.005
"""Opacity below which Gaussians are removed (3DGS)."""

SPLIT_SHRINK = 1.6
"""Factor by which the children of a split are smaller than their parent (3DGS: 0.8 · 2)."""


@torch.no_grad()
def gather(gaussians: Gaussians, optimizer: Adam, parents: Int64[Tensor, " M"], num_kept: int) -> None:
    """Replaces Gaussians by copies of ``parents``, together with Adam's moments.

    Args:
        gaussians: Changed in place.
        optimizer: From ``optimizer.make_optimizer``.
        parents: [M] indices of Gaussians.
        num_kept: Number of Gaussians, from the first, that keep their parents' moments; the others' start at 0.
    """
    gaussians.gather(parents)
    for parameter in gaussians.parameters():
        state = optimizer.state.get(parameter, {})
        for name in MOMENTS:
            if name in state:
                moments = state[name][parents]
                moments[num_kept:] = 0.0
                state[name] = moments


@torch.no_grad()
def append(gaussians: Gaussians, optimizer: Adam, added: Gaussians) -> None:
    """Appends Gaussians, of the same degree of spherical harmonics and from any device; their moments start at 0."""
    gaussians.append(added)
    for parameter in gaussians.parameters():
        state = optimizer.state.get(parameter, {})
        for moment in MOMENTS:
            if moment in state:
                state[moment] = torch.cat([state[moment], state[moment].new_zeros(len(added), *parameter.shape[1:])])


@torch.no_grad()
def reset_moments(optimizer: Adam, parameter: nn.Parameter) -> None:
    """Sets Adam's moments of a parameter to 0, because its values were replaced."""
    state = optimizer.state.get(parameter, {})
    for name in MOMENTS:
        if name in state:
            state[name].zero_()


@torch.no_grad()
def remove(gaussians: Gaussians, optimizer: Adam, indices: Int64[Tensor, " K"]) -> None:
    """Removes Gaussians; the others keep their order."""
    kept = _others(gaussians, indices)
    gather(gaussians, optimizer, kept, num_kept=len(kept))


@torch.no_grad()
def clone(gaussians: Gaussians, optimizer: Adam, indices: Int64[Tensor, " K"]) -> None:
    """Appends copies of Gaussians; the moments of the copies start at 0."""
    num = len(gaussians)
    parents = torch.cat([torch.arange(num, device=indices.device), indices])
    gather(gaussians, optimizer, parents, num_kept=num)


@torch.no_grad()
def split(gaussians: Gaussians, optimizer: Adam, indices: Int64[Tensor, " K"], generator: torch.Generator) -> None:
    """Replaces Gaussians by two children each, at the end, whose moments start at 0.

    Children are smaller by ``SPLIT_SHRINK``. A CPU generator samples their positions from the density of their parents.
    """
    if not len(indices):
        return
    kept = _others(gaussians, indices)
    gather(gaussians, optimizer, torch.cat([kept, indices.repeat(2)]), num_kept=len(kept))
    first = len(kept)
    scales = gaussians.scales[first:]
    noise = torch.randn(scales.shape, dtype=torch.float32, generator=generator).to(scales.device) * scales
    gaussians.means[first:] += rotated(noise, gaussians.quats[first:])
    gaussians.log_scales[first:] = (scales / SPLIT_SHRINK).log()


def _others(gaussians: Gaussians, indices: Int64[Tensor, " K"]) -> Int64[Tensor, " M"]:
    """The indices of all other Gaussians."""
    is_other = torch.ones(len(gaussians), dtype=torch.bool, device=indices.device)
    is_other[indices] = False
    return is_other.nonzero()[:, 0]


def rotated(vectors: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3"]:
    """Vectors rotated by quaternions (w, x, y, z), which need not be normalized."""
    quats = torch.nn.functional.normalize(quats, dim=1)
    w, axis = quats[:, :1], quats[:, 1:]
    # Rotation of v by a unit quaternion (w, u): v + 2 u × (u × v + w v).
    return vectors + 2.0 * torch.linalg.cross(axis, torch.linalg.cross(axis, vectors) + w * vectors)


@torch.no_grad()
def shorten_needles(gaussians: Gaussians, max_elongation: float, free_sizes: Float[Tensor, " N"]) -> None:
    """Shortens the longest axis of large Gaussians to at most ``max_elongation`` times the second longest.

    Needles at the border of what the training views show are streaks in views of what lies beyond
    (docs/design/needles.md). Flat Gaussians stay: surfaces need them.

    Args:
        gaussians: Changed in place.
        max_elongation: A number below 1 counts as 1.
        free_sizes: [N] size up to which each Gaussian may have any shape [scene units]; may be infinite.
    """
    second = gaussians.log_scales.median(1, keepdim=True).values
    longest = (second + math.log(max(max_elongation, 1.0))).maximum(free_sizes.log()[:, None])
    gaussians.log_scales.clamp_(max=longest)
