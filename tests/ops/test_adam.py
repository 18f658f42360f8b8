"""Adam (Kingma and Ba 2015) against torch's own."""

import pytest
import torch

from tests.scenes import generator
from warpgs.ops.adam import Adam

BETAS, EPSILON = (0.9, 0.999), 1e-15
RATES = (0.01, 0.3)


def parameters():
    return [torch.randn(shape, generator=generator(k)).requires_grad_() for k, shape in enumerate([(50, 3), (7,)])]


def make(params):
    rates = torch.tensor(RATES)
    return Adam([{"params": [p], "lr": r} for p, r in zip(params, rates.unbind(), strict=True)], BETAS, EPSILON), rates


def test_steps_are_those_of_torch():
    ours, theirs = parameters(), parameters()
    optimizer, _ = make(ours)
    groups = [{"params": [p], "lr": r} for p, r in zip(theirs, RATES, strict=True)]
    expected = torch.optim.Adam(groups, betas=BETAS, eps=EPSILON)
    for step in range(20):
        for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            a.grad = torch.randn(a.shape, generator=generator(100 + 2 * step + k))
            b.grad = a.grad.clone()
        optimizer.step()
        expected.step()
    for a, b in zip(ours, theirs, strict=True):
        assert torch.allclose(a, b, rtol=1e-6, atol=2e-6)
        for name in ("exp_avg", "exp_avg_sq"):
            assert torch.allclose(optimizer.state[a][name], expected.state[b][name], rtol=1e-6, atol=1e-7)


def test_the_first_step_has_the_length_of_the_rate():
    (parameter, _) = params = parameters()
    optimizer, _ = make(params)
    before = parameter.detach().clone()
    parameter.grad = 1e-6 * torch.randn(parameter.shape, generator=generator(3))
    optimizer.step()
    assert torch.allclose((parameter - before).abs(), torch.full_like(before, RATES[0]), rtol=1e-4)


def test_rates_are_read_anew_in_every_step():
    (parameter, _) = params = parameters()
    optimizer, rates = make(params)
    rates.zero_()
    before = parameter.detach().clone()
    parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    assert torch.equal(parameter, before)


def test_a_parameter_without_a_gradient_stays_and_its_steps_are_not_counted():
    params = parameters()
    optimizer, _ = make(params)
    before = params[1].detach().clone()
    params[0].grad = torch.ones_like(params[0])
    optimizer.step()
    assert torch.equal(params[1], before)
    assert params[1] not in optimizer.state
    assert optimizer.state[params[0]]["step"] == 1.0


@pytest.mark.parametrize("shape", [(0, 3), (1,), ()])
def test_parameters_of_any_shape_are_taken(shape):
    parameter = torch.zeros(shape, requires_grad=True)
    optimizer = Adam([{"params": [parameter], "lr": torch.tensor(0.5)}], BETAS, EPSILON)
    parameter.grad = torch.ones(shape)
    optimizer.step()
    assert torch.allclose(parameter, torch.full(shape, -0.5))
