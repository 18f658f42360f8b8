"""Robust nonlinear least squares by the method of Levenberg and Marquardt, for few parameters on any device.

SciPy's ``least_squares`` works on the CPU, and with a sparse Jacobian its steps span only two directions.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

DAMPING, DAMPING_FACTOR = 1e-3, 10.0
"""Initial damping, and the factor by which failures raise it and successes lower it."""


class Problem(NamedTuple):
    """The least-squares problem.

    Attributes:
        residuals: The residuals e at [P] parameters.
        loss: The robust loss of residuals.
        normal_equations: At parameters and with their residuals, [P, P] JᵀWJ and [P] JᵀWe, with the derivatives J of
            the residuals and the weights W that make their squares the loss.
    """

    residuals: Callable[[Float[Tensor, " P"]], Tensor]
    loss: Callable[[Tensor], float]
    normal_equations: Callable[[Float[Tensor, " P"], Tensor], tuple[Float[Tensor, "P P"], Float[Tensor, " P"]]]


def minimize(
    problem: Problem, start: Float[Tensor, " P"], max_trials: int, min_gain: float, limit: float = math.inf
) -> Float[Tensor, " P"]:
    """The parameters of a minimum of the loss.

    Args:
        problem: The problem.
        start: [P] where to start from.
        max_trials: Maximum number of steps that are tried.
        min_gain: Minimum relative gain of the loss for which another step is tried.
        limit: Maximum absolute value of each parameter.
    """
    x, damping = start, DAMPING
    residuals = problem.residuals(x)
    loss = problem.loss(residuals)
    normal, gradient = problem.normal_equations(x, residuals)
    for _ in range(max_trials):
        # The small number keeps the matrix regular where no residual depends on a parameter.
        damped = normal + (damping * normal.diagonal() + 1e-9).diag()
        trial = (x - torch.linalg.solve(damped, gradient)).clamp(-limit, limit)
        trial_residuals = problem.residuals(trial)
        trial_loss = problem.loss(trial_residuals)
        if not trial_loss < loss:
            damping *= DAMPING_FACTOR
            continue
        gain, damping = 1.0 - trial_loss / loss, damping / DAMPING_FACTOR
        x, residuals, loss = trial, trial_residuals, trial_loss
        if gain < min_gain:
            break
        normal, gradient = problem.normal_equations(x, residuals)
    return x
