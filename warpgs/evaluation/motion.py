"""Whether motion is smooth between the times of the training frames, where no frame shows what happens."""

import itertools
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.model.splats import Splats


@torch.no_grad()
def jitter(splats_at: Callable[[float], Splats], times: Sequence[float]) -> float | None:
    """How far dynamic Gaussians deviate from straight paths, halfway between two neighbouring times.

    Σ o ‖p(½ (t₀ + t₁)) − ½ (p(t₀) + p(t₁))‖ / Σ o ‖p(t₁) − p(t₀)‖ over all neighbouring times and all dynamic
    Gaussians, with their positions p and opacities o. It is 0 for motion along straight lines at constant speed, and
    small if times are close to each other. Where a network memorized the times of its training frames, it is large.

    Args:
        splats_at: Splats at a time in [0, 1], with ``is_dynamic``.
        times: Times of the training frames, in any order.

    Returns:
        None if there are fewer than two times or if nothing moves.
    """
    deviation, length = 0.0, 0.0
    ordered = sorted(set(times))
    at_times = (_dynamic(splats_at(time)) for time in ordered)
    for (start, end), ((before, opacities), (after, _)) in zip(
        itertools.pairwise(ordered), itertools.pairwise(at_times), strict=True
    ):
        middle, _ = _dynamic(splats_at(0.5 * (start + end)))
        deviation += (opacities * (middle - 0.5 * (before + after)).norm(dim=1)).sum().item()
        length += (opacities * (after - before).norm(dim=1)).sum().item()
    return deviation / length if length > 0 else None


def _dynamic(splats: Splats) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
    """Positions and opacities of the dynamic Gaussians, in double precision."""
    assert splats.is_dynamic is not None
    return splats.means[splats.is_dynamic].double(), splats.opacities[splats.is_dynamic].double()
