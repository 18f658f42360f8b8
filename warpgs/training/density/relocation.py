"""Copies of a Gaussian at its place that together look as it did (Kheradmand et al. 2024, Eq. 9).

Of N equal copies with opacity a and standard deviation s', a ray through the Gaussian composites

    1 − (1 − a g(x / s'))^N = Σ_j C(N, j) (−1)^(j−1) a^j g(√j x / s'),  j = 1 … N,  g(x) = exp(−x² / 2)

The centre keeps the opacity o with a = 1 − (1 − o)^(1/N). The integral over x, to which the term of j adds its factor
times √(2π/j) s', is that of o g(x / s) with s' = o s / Σ_j C(N, j) (−1)^(j−1) a^j / √j. The double sum of Eq. 9 is this
one, because Σ_i C(i − 1, j − 1) = C(N, j) over i = j … N.
"""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.model.gaussians import Gaussians
from warpgs.ops.adam import Adam
from warpgs.training import optimizer as optim

MAX_COPIES = 51
"""Maximum of N, as in the code of the paper's authors; in double precision, the sum has ten correct digits."""

MAX_OPACITY = 1.0 - 1e-7
"""Opacity above which Gaussians count as that opaque: at 1, the terms of the sum would have no digit in common."""


def relocated(
    opacities: Float[Tensor, " K"], counts: Int64[Tensor, " K"], min_opacity: float
) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
    """Opacity and relative size of each of N equal copies of a Gaussian.

    Args:
        opacities: [K] opacities of Gaussians, in [0, 1].
        counts: [K] number N of copies that take the place of each; counts as at most ``MAX_COPIES``.
        min_opacity: Minimum opacity of a copy, positive.

    Returns:
        [K] opacity of a copy, and [K] factor of its standard deviations.
    """
    whole, counts = opacities.double().clamp(max=MAX_OPACITY), counts.clamp(max=MAX_COPIES)
    each = (-torch.expm1(torch.log1p(-whole) / counts)).clamp(min=min_opacity)
    terms = range(1, MAX_COPIES + 1)
    signed = [[(-1.0) ** (j - 1) * math.comb(n, j) / math.sqrt(j) for j in terms] for n in range(MAX_COPIES + 1)]
    coefficients = torch.tensor(signed, dtype=torch.float64, device=whole.device)
    powers = each[:, None] ** torch.tensor(terms, dtype=torch.float64, device=whole.device)
    return each.float(), (whole / (coefficients[counts] * powers).sum(1)).float()


@torch.no_grad()
def respawn(
    gaussians: Gaussians,
    optimizer: Adam,
    is_dead: Bool[Tensor, " N"],
    num_added: int,
    min_opacity: float,
    generator: torch.Generator,
) -> None:
    """Replaces dead Gaussians by copies of others and adds more copies; nothing changes on screen.

    Which are copied is chosen at random, in proportion to their opacities. If all are dead, all are removed.

    Args:
        gaussians: Changed in place; the moments of copies and of those that were copied start at 0.
        optimizer: From ``optimizer.make_optimizer``.
        is_dead: [N] which ones are replaced.
        num_added: By how many their number grows.
        min_opacity: Minimum opacity of copies.
        generator: CPU generator.
    """
    alive = (~is_dead).nonzero()[:, 0]
    count = len(gaussians) - len(alive) + num_added if len(alive) else 0
    chances = gaussians.opacities[alive].double().cumsum(0)
    points = torch.rand(count, dtype=torch.float64, generator=generator).to(chances.device) * chances[-1:]
    copied = alive[torch.searchsorted(chances, points).clamp(max=len(alive) - 1)]
    num_copies = torch.bincount(copied, minlength=len(gaussians))
    kept = (~is_dead & (num_copies == 0)).nonzero()[:, 0]
    changed = torch.cat([num_copies.nonzero()[:, 0], copied])
    opacities, factors = relocated(gaussians.opacities[changed], num_copies[changed] + 1, min_opacity)
    optim.gather(optimizer, gaussians, torch.cat([kept, changed]), num_kept=len(kept))
    gaussians.logit_opacities[len(kept) :] = torch.logit(opacities)
    gaussians.log_scales[len(kept) :] += factors.log()[:, None]
