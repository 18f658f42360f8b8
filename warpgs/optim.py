"""The one Adam over Gaussians and networks, and its learning rates."""

import torch
from jaxtyping import Int64
from torch import Tensor, nn

from .config import OptimConfig
from .scene.gaussians import Gaussians
from .scene.split import SplitScene

BETAS = (0.9, 0.999)
EPSILON = 1e-15
"""Of 3DGS: gradients of Gaussians that are hardly seen are tiny and should count all the same."""

MEANS_DECAY = 0.01
"""Rate of positions at the end of a run, relative to its start (3DGS)."""


def make_optimizer(scene: SplitScene) -> torch.optim.Adam:
    """Adam with one named group for each Gaussian parameter of each branch and one for each network."""
    groups = [
        {"name": f"{branch}.{name}", "params": [parameter], "lr": 0.0}
        for branch, gaussians in (("static", scene.static), ("dynamic", scene.dynamic))
        for name, parameter in gaussians.named_parameters()
    ]
    groups += [
        {"name": name, "params": list(network.parameters()), "lr": 0.0}
        for name, network in (("deformation", scene.deformation), ("appearance", scene.appearance))
    ]
    return torch.optim.Adam(groups, betas=BETAS, eps=EPSILON, fused=True)


def set_learning_rates(
    optimizer: torch.optim.Adam, config: OptimConfig, extent: float, progress: float, network_progress: dict[str, float]
) -> None:
    """Sets every group's rate.

    Args:
        optimizer: From ``make_optimizer``.
        config: Rates.
        extent: Of the capture [scene units]; scales the rate of positions.
        progress: Share of the run done, in [0, 1].
        network_progress: The same for each network, over the iterations in which it is trained.
    """
    for group in optimizer.param_groups:
        name = group["name"]
        if name in network_progress:
            group["lr"] = exponential(config.networks, config.networks_end, network_progress[name])
            continue
        kind = name.split(".")[1]
        if kind == "means":
            group["lr"] = exponential(config.means, MEANS_DECAY * config.means, progress) * extent
        else:
            group["lr"] = _RATES[kind](config)


_RATES = {
    "quats": lambda config: config.quats,
    "log_scales": lambda config: config.scales,
    "logit_opacities": lambda config: config.opacities,
    "sh_dc": lambda config: config.sh_dc,
    "sh_rest": lambda config: config.sh_rest,
}


def exponential(start: float, end: float, progress: float) -> float:
    """From ``start`` at progress 0 to ``end`` at 1, log-linearly; constant outside."""
    progress = min(max(progress, 0.0), 1.0)
    return float(start ** (1.0 - progress) * end**progress)


@torch.no_grad()
def gather(optimizer: torch.optim.Adam, gaussians: Gaussians, parents: Int64[Tensor, " M"], num_kept: int) -> None:
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
def forget(optimizer: torch.optim.Adam, parameter: nn.Parameter) -> None:
    """Sets the moments of a parameter that was overwritten to 0."""
    state = optimizer.state.get(parameter, {})
    for name in ("exp_avg", "exp_avg_sq"):
        if name in state:
            state[name].zero_()
