"""Adam over Gaussians, networks and camera poses, and its learning rates.

With N ranks a step averages the gradients of N views. Adam is scaled to that as in gsplat
(``create_splats_with_optimizers`` in ``examples/simple_trainer.py``) and Grendel-GS (``training_setup`` in
``scene/gaussian_model.py``, mode ``sqrt``), after Malladi et al. 2022, "On the SDEs and scaling rules for adaptive
gradient algorithms": learning rates times √N, ε divided by √N. The decay rates of the moments are βᴺ, as in Grendel-GS;
gsplat's 1 − N (1 − β) agrees to first order, but is 0 for ten ranks.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from warpgs.config import OptimConfig
from warpgs.model.gaussians import PARAMETERS
from warpgs.model.poses import PoseCorrections
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam
from warpgs.runtime import ranks

BETAS = (0.9, 0.999)
EPSILON = 1e-15
"""Adam's ε, that of 3DGS: Gaussians that are hardly visible have tiny gradients, which should count all the same."""

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Names of Adam's moments in the state of a parameter."""

FIXED_RATES = {"quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 0.05, "sh_rest": 1.25e-4}
"""Learning rates of parameters of Gaussians that no preset changes (3DGS, Deformable-3DGS)."""

REFLECTANCES = 2.5e-3
"""Learning rate of the dynamic Gaussians' reflectances, that of colours (3DGS)."""

DOME, DOME_DECAY = 2.5e-3, 0.01
"""Learning rate of the colours of the sky, and the final one relative to it."""

MEANS_DECAY = 0.01
"""Final learning rate of positions, relative to the initial one (3DGS)."""

SETTLE_DECAY = 0.1
"""Final learning rate of the other parameters of Gaussians, relative to that until they settle."""

POSES_DECAY = 0.01
"""Final learning rate of camera poses, relative to the initial one."""

BRANCHES = ("static", "dynamic")
NETWORKS = ("deformation", "appearance")
REFLECTIONS = ("dynamic.reflectances", "light")
GROUPS = (*(f"{branch}.{name}" for branch in BRANCHES for name in PARAMETERS), *NETWORKS, "poses", *REFLECTIONS, "dome")
"""Names of the parameter groups: each Gaussian parameter of each branch, each network, the camera poses, what dynamic
Gaussians reflect, and the sky."""


def trained_parameters(scene: SplitScene, poses: PoseCorrections | None) -> dict[str, nn.Parameter]:
    """Everything that is trained, by names that begin with that of a group."""
    named = dict(scene.named_parameters())
    if poses is not None:
        named |= {f"poses.{name}": parameter for name, parameter in poses.named_parameters()}
    return named


def make_optimizer(parameters: Mapping[str, nn.Parameter], rates: Mapping[str, Tensor]) -> Adam:
    """Adam with the groups of ``GROUPS``.

    Args:
        parameters: From ``trained_parameters``.
        rates: Learning rate of each group, a scalar on the scene's device that the optimizer reads in every step.
    """
    groups = [
        {
            "name": name,
            "params": [p for n, p in parameters.items() if n == name or n.startswith(f"{name}.")],
            "lr": rates[name],
        }
        for name in GROUPS
    ]
    num = ranks.num_ranks()
    return Adam(groups, (BETAS[0] ** num, BETAS[1] ** num), EPSILON / math.sqrt(num))


@dataclass(frozen=True)
class RatePlan:
    """What the learning rates of an iteration depend on.

    Attributes:
        progress: Fraction of the run done, in [0, 1].
        settle_progress: Fraction done of the iterations in which Gaussians settle (``Schedule.settle``).
        means_progress: By branch, fraction done of the decay of its positions' learning rate.
        network_progress: By network, fraction done of the iterations in which it is trained.
        warmup_factors: By network, factor of its learning rate; rises from 0 to 1 once the network is in use.
    """

    progress: float
    settle_progress: float
    means_progress: dict[str, float]
    network_progress: dict[str, float]
    warmup_factors: dict[str, float]


def learning_rates(config: OptimConfig, unit: float, at: RatePlan) -> dict[str, float]:
    """Learning rate of each group of ``GROUPS``, for a step over as many views as there are ranks.

    Args:
        config: Rates of one view per step.
        unit: Length of 1 in the rate of positions (``TrainConfig.means_unit``) [scene units].
        at: Of the iteration.
    """
    gaussians = {**FIXED_RATES, "sh_dc": config.sh_dc}
    settled = exponential(1.0, SETTLE_DECAY, at.settle_progress)
    rates = {f"{branch}.{name}": settled * rate for branch in BRANCHES for name, rate in gaussians.items()}
    for branch in BRANCHES:
        decayed = exponential(config.means, MEANS_DECAY * config.means, at.means_progress[branch])
        rates[f"{branch}.means"] = decayed * unit
    for name in NETWORKS:
        rate = exponential(config.networks, config.networks_end, at.network_progress[name])
        rates[name] = at.warmup_factors[name] * rate
    rates["dynamic.reflectances"] = settled * REFLECTANCES
    rates["light"] = exponential(config.networks, config.networks_end, at.network_progress["deformation"])
    rates["dome"] = exponential(DOME, DOME_DECAY * DOME, at.progress)
    rates["poses"] = exponential(config.poses, POSES_DECAY * config.poses, at.progress)
    return {name: math.sqrt(ranks.num_ranks()) * rate for name, rate in rates.items()}


def exponential(start: float, end: float, progress: float) -> float:
    """Log-linear interpolation from ``start`` at progress 0 to ``end`` at 1; constant outside."""
    progress = min(max(progress, 0.0), 1.0)
    return float(start ** (1.0 - progress) * end**progress)


@torch.no_grad()
def average_gradients(optimizer: Adam) -> None:
    """Replaces the gradients of every rank by their means over the ranks, in one transfer.

    Which parameters have gradients must be the same on all ranks: it depends on the ``Phase`` alone.
    """
    trained = [p for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    if ranks.num_ranks() == 1 or not trained:
        return
    flat = torch.cat([parameter.grad.reshape(-1) for parameter in trained])
    ranks.add_(flat)
    flat /= ranks.num_ranks()
    for parameter, gradient in zip(trained, flat.split([p.numel() for p in trained]), strict=True):
        parameter.grad = gradient.view_as(parameter)


@torch.no_grad()
def copy_first(parameters: Sequence[nn.Parameter], optimizer: Adam | None = None) -> None:
    """Replaces parameters and Adam's moments by those of rank 0, where their first axes may have other lengths.

    Args:
        parameters: The same ones, in the same order, on all ranks. What keeps its shape stays at its address.
        optimizer: From ``make_optimizer``; None before it has any state.
    """
    if ranks.num_ranks() == 1:
        return
    lengths = torch.tensor([parameter.shape[:1].numel() for parameter in parameters])
    ranks.copy_first_(lengths)
    for parameter, length in zip(parameters, lengths.tolist(), strict=True):
        state = {} if optimizer is None else optimizer.state.get(parameter, {})
        if parameter.shape[:1].numel() != length:
            parameter.grad = None
            parameter.data = parameter.new_empty(length, *parameter.shape[1:])
            state.update({name: torch.empty_like(parameter) for name in MOMENTS if name in state})
        for tensor in (parameter.data, *(state[name] for name in MOMENTS if name in state)):
            ranks.copy_first_(tensor)
