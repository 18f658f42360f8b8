"""Adam (Kingma and Ba 2015) against the reference and torch."""

import pytest
import torch

from tests.reference.adam import adam as reference
from tests.scenes import generator, relative_error
from warpgs.kernels.adam import BLOCK, MAX_PARAMETERS, PER_THREAD
from warpgs.ops.adam import Adam
from warpgs.runtime.profiling import profile


@pytest.fixture(autouse=True, params=["torch", "kernel"])
def implementation(request, monkeypatch):
    """Each test runs torch's implementation, which is that of the CPU, and the kernel of CUDA."""
    if request.param == "kernel":
        monkeypatch.setattr(Adam, "_step_on_cpu", Adam._launch)


BETAS, EPSILON = (0.9, 0.999), 1e-15
RATES = (0.01, 0.3)


def parameters():
    return [torch.randn(shape, generator=generator(k)).requires_grad_() for k, shape in enumerate([(50, 3), (7,)])]


def make(params):
    rates = torch.tensor(RATES)
    return Adam([{"params": [p], "lr": r} for p, r in zip(params, rates.unbind(), strict=True)], BETAS, EPSILON), rates


def test_steps_equal_the_reference():
    params = parameters()
    optimizer, _ = make(params)
    gradients = [[torch.randn(p.shape, generator=generator(10 * k)) for k in range(1, 21)] for p in params]
    doubles = [p.detach().double() for p in params]
    for step in zip(*gradients, strict=True):
        for parameter, gradient in zip(params, step, strict=True):
            parameter.grad = gradient
        optimizer.step()
    for parameter, start, steps, rate in zip(params, doubles, gradients, RATES, strict=True):
        expected, mean, square = reference(start, [g.double() for g in steps], rate, BETAS, EPSILON)
        assert relative_error(parameter.detach(), expected) < 1e-6
        assert relative_error(optimizer.state[parameter]["exp_avg"], mean) < 1e-6
        assert relative_error(optimizer.state[parameter]["exp_avg_sq"], square) < 1e-6


def test_steps_equal_those_of_torch():
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


def test_the_length_of_the_first_step_is_the_learning_rate():
    (parameter, _) = params = parameters()
    optimizer, _ = make(params)
    before = parameter.detach().clone()
    parameter.grad = 1e-6 * torch.randn(parameter.shape, generator=generator(3))
    optimizer.step()
    assert torch.allclose((parameter - before).abs(), torch.full_like(before, RATES[0]), rtol=1e-4)


def test_rates_are_read_in_every_step():
    (parameter, _) = params = parameters()
    optimizer, rates = make(params)
    rates.zero_()
    before = parameter.detach().clone()
    parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    assert torch.equal(parameter, before)


def test_a_parameter_without_a_gradient_is_skipped():
    params = parameters()
    optimizer, _ = make(params)
    before = params[1].detach().clone()
    params[0].grad = torch.ones_like(params[0])
    optimizer.step()
    assert torch.equal(params[1], before)
    assert params[1] not in optimizer.state
    assert optimizer.state[params[0]]["step"] == 1.0


ANY_STRIDES = torch.randn(4, 3, generator=generator()).T


@pytest.mark.parametrize("gradient", [ANY_STRIDES, *(torch.ones(shape) for shape in ((0, 3), (1,), ()))])
def test_parameters_may_have_any_shape_and_gradients_any_strides(gradient):
    parameter = torch.zeros(gradient.shape, requires_grad=True)
    optimizer = Adam([{"params": [parameter], "lr": torch.tensor(0.5)}], BETAS, EPSILON)
    parameter.grad = gradient
    optimizer.step()
    assert torch.allclose(parameter.detach(), -0.5 * gradient.sign(), rtol=1e-6)


@pytest.mark.parametrize("values", [torch.zeros(4, 3).T, torch.zeros(5, dtype=torch.float64)])
def test_the_kernel_refuses_what_it_would_read_as_other_numbers(values, monkeypatch):
    monkeypatch.setattr(Adam, "_step_on_cpu", Adam._launch)
    parameter = values.requires_grad_()
    parameter.grad = torch.ones_like(values)
    with pytest.raises(ValueError, match=r"Adam needs contiguous torch\.float32, got torch\.float"):
        Adam([{"params": [parameter], "lr": torch.tensor(0.1)}]).step()
    assert not parameter.any()


SIZES = [0, 1, 7, BLOCK, BLOCK * PER_THREAD + 1, 3 * BLOCK * PER_THREAD - 5, *[3] * MAX_PARAMETERS]


def test_parameters_that_share_a_launch_are_updated_as_alone():
    """Whatever their number and sizes; a step may be the first one of some."""
    ours = [torch.randn(size, generator=generator(size)).requires_grad_() for size in SIZES]
    alone = [p.detach().clone().requires_grad_() for p in ours]
    rates = [torch.tensor(0.01 * k) for k in range(len(SIZES))]
    together = Adam([{"params": [p], "lr": r} for p, r in zip(ours, rates, strict=True)], BETAS, EPSILON)
    others = [Adam([{"params": [p], "lr": r}], BETAS, EPSILON) for p, r in zip(alone, rates, strict=True)]
    for step in range(3):
        for k, (a, b) in enumerate(zip(ours, alone, strict=True)):
            a.grad = None if step == 0 and k % 3 == 0 else torch.randn(len(a), generator=generator(100 * step + k))
            b.grad = None if a.grad is None else a.grad.clone()
        for optimizer in (together, *others):
            optimizer.step()
    for a, b, optimizer in zip(ours, alone, others, strict=True):
        assert torch.equal(a, b)
        for name in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(together.state[a][name], optimizer.state[b][name])


@pytest.mark.parametrize(("num", "launches"), [(1, 2), (MAX_PARAMETERS, 2), (MAX_PARAMETERS + 1, 4)])
def test_launches_do_not_become_more_with_each_parameter(num, launches):
    params = [torch.ones(5, requires_grad=True) for _ in range(num)]
    optimizer = Adam([{"params": params, "lr": torch.tensor(0.1)}], BETAS, EPSILON)
    for parameter in params:
        parameter.grad = torch.ones_like(parameter)
    with profile() as profiled, pytest.MonkeyPatch.context() as patch:
        patch.setattr(Adam, "_step_on_cpu", Adam._launch)
        optimizer.step()
    assert len(profiled.times()) == launches
