"""The method of Levenberg and Marquardt."""

import pytest
import torch

from warpgs.least_squares import Problem, minimize


def problem(residuals):
    """The sum of the squares of residuals, with exact derivatives."""

    def normal_equations(x, at_x):
        jacobian = torch.autograd.functional.jacobian(residuals, x)
        return jacobian.T @ jacobian, jacobian.T @ at_x

    return Problem(residuals, lambda at_x: float(at_x.square().sum()), normal_equations)


def rosenbrock(x):
    """Residuals of Rosenbrock's curved valley; both are 0 at (1, 1)."""
    return torch.stack([1.0 - x[0], 10.0 * (x[1] - x[0] ** 2)])


START = torch.tensor([-1.2, 1.0], dtype=torch.float64)


def test_the_minimum_of_a_curved_valley_is_found():
    found = minimize(problem(rosenbrock), START, max_trials=60, min_gain=1e-12)
    assert found.tolist() == pytest.approx([1.0, 1.0], abs=1e-6)


def test_parameters_stay_within_the_limit():
    found = minimize(problem(lambda x: x - 7.0), torch.zeros(3, dtype=torch.float64), 60, 1e-12, limit=2.0)
    assert found.tolist() == [2.0, 2.0, 2.0]


def test_parameters_without_influence_keep_their_values():
    found = minimize(problem(lambda x: x[:1] - 3.0), START, 60, 1e-12)
    assert found.tolist() == pytest.approx([3.0, 1.0])


def test_a_step_that_raises_the_loss_is_not_taken():
    """Gauss and Newton's step from 3 on leads to the far side of arctan, where it is larger."""
    found = minimize(problem(torch.arctan), torch.tensor([3.0], dtype=torch.float64), max_trials=1, min_gain=0.0)
    assert found.tolist() == [3.0]
    found = minimize(problem(torch.arctan), torch.tensor([3.0], dtype=torch.float64), max_trials=60, min_gain=1e-12)
    assert found.tolist() == pytest.approx([0.0], abs=1e-6)


def test_no_further_step_is_tried_after_a_small_gain():
    tried = []
    halved = problem(lambda x: (tried.append(1), x - 3.0)[1])
    minimize(halved._replace(normal_equations=lambda x, at_x: (torch.eye(1).double(), 0.01 * at_x)), START[:1], 60, 0.5)
    assert len(tried) == 2
