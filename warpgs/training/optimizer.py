"""The one Adam over Gaussians and networks, and its learning rates."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from warpgs.config import OptimConfig
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam

BETAS = (0.9, 0.999)
EPSILON = 1e-15
"""Of 3DGS: gradients of Gaussians that are hardly seen are tiny and should count all the same."""

MEANS_DECAY = 0.01
"""Rate of positions at the end of a run, relative to its start (3DGS)."""


GROUPS = (
    *(f"{branch}.{name}" for branch in ("static", "dynamic") for name in PARAMETERS),
    "deformation",
    "appearance",
)
"""Names of the parameter groups: each Gaussian parameter of each branch, and each network."""


def make_optimizer(scene: SplitScene, rates: Float[Tensor, " groups"]) -> Adam:
    """Adam with the groups of ``GROUPS``.

    Args:
        scene: What is trained.
        rates: Learning rate of each group, on the scene's device; the optimizer reads it anew in every step.
    """
    parameters = dict(scene.named_parameters())
    groups = [
        {
            "name": name,
            "params": [p for n, p in parameters.items() if n == name or n.startswith(f"{name}.")],
            "lr": rate,
        }
        for name, rate in zip(GROUPS, rates.unbind(), strict=True)
    ]
    return Adam(groups, BETAS, EPSILON)


def learning_rates(
    config: OptimConfig, extent: float, progress: float, network_progress: dict[str, float], warmth: dict[str, float]
) -> list[float]:
    """Learning rate of each group of ``GROUPS``.

    Args:
        config: Rates.
        extent: Of the capture [scene units]; scales the rate of positions.
        progress: Share of the run done, in [0, 1].
        network_progress: The same for each network, over the iterations in which it is trained.
        warmth: Share of its rate that each network has.
    """
    gaussians = [
        exponential(config.means, MEANS_DECAY * config.means, progress) * extent,
        config.quats,
        config.scales,
        config.opacities,
        config.sh_dc,
        config.sh_rest,
    ]
    networks = [
        warmth[name] * exponential(config.networks, config.networks_end, network_progress[name])
        for name in ("deformation", "appearance")
    ]
    return [*gaussians, *gaussians, *networks]


def exponential(start: float, end: float, progress: float) -> float:
    """From ``start`` at progress 0 to ``end`` at 1, log-linearly; constant outside."""
    progress = min(max(progress, 0.0), 1.0)
    return float(start ** (1.0 - progress) * end**progress)


@torch.no_grad()
def gather(optimizer: Adam, gaussians: Gaussians, parents: Int64[Tensor, " M"], num_kept: int) -> None:
    """Resizes Gaussians and their moments: the first ``num_kept`` keep their parents', the others start at 0."""
    gaussians.gather(parents)
    for parameter in gaussians.parameters():
        state = optimizer.state.get(parameter, {})
        for name in ("exp_avg", "exp_avg_sq"):
            if name in state:
                moments = state[name][parents]
                moments[num_kept:] = 0.0
                state[name] = moments


@torch.no_grad()
def forget(optimizer: Adam, parameter: nn.Parameter) -> None:
    """Sets the moments of a parameter that was overwritten to 0."""
    state = optimizer.state.get(parameter, {})
    for name in ("exp_avg", "exp_avg_sq"):
        if name in state:
            state[name].zero_()
