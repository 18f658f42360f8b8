"""Dropout of Gaussians while they are trained (DropGaussian)."""

import pytest
import torch

from tests.reference import dropout as reference
from tests.scenes import generator
from warpgs.ops.dropout import MAX_SEED, dropout

NUM = 20_000


def seed(value):
    return torch.tensor([float(value)])


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.7])
def test_opacities_and_their_gradients_equal_the_reference(fraction):
    opacities = torch.rand(500, generator=generator(3)).requires_grad_()
    twin = opacities.detach().double().requires_grad_()
    ours, expected = dropout(opacities, seed(12345), fraction), reference.dropout(twin, 12345, fraction)
    weights = torch.rand(500, generator=generator(4))
    ours.backward(weights)
    expected.backward(weights.double())
    assert torch.allclose(ours.double(), expected, rtol=1e-6, atol=0.0)
    assert torch.allclose(opacities.grad.double(), twin.grad, rtol=1e-6, atol=0.0)


def test_a_random_fraction_is_omitted_and_the_others_are_scaled():
    opacities = 0.9 * torch.rand(NUM, generator=generator(0)) + 1e-3
    dropped = dropout(opacities, seed(5), 0.2)
    kept = dropped > 0.0
    assert kept.float().mean().item() == pytest.approx(0.8, abs=0.01)  # 3.5 standard deviations
    assert torch.equal(dropped[kept], (opacities[kept] * (1.0 / torch.tensor(0.8))).clamp_max(1.0))
    assert dropped.max() == 1.0


def test_the_expected_opacity_stays():
    opacities = torch.full((NUM,), 0.5)
    assert dropout(opacities, seed(1), 0.3).mean().item() == pytest.approx(0.5, abs=0.01)


def test_gradients_reach_what_was_kept_below_an_opacity_of_one():
    opacities = torch.tensor([0.3, 0.95] * 100).requires_grad_()
    dropped = dropout(opacities, seed(2), 0.1)
    dropped.sum().backward()
    is_free = (dropped > 0.0) & (dropped < 1.0)
    assert 0 < is_free.sum() < 100
    assert torch.allclose(opacities.grad[is_free], torch.tensor(1.0 / 0.9))
    assert (opacities.grad[~is_free] == 0.0).all()


def test_each_seed_omits_others():
    ones = torch.ones(NUM)
    first, again, last = (dropout(ones, seed(k), 0.5) for k in (7, 7, MAX_SEED - 1))
    assert torch.equal(first, again)
    assert ((first > 0.0) == (last > 0.0)).float().mean().item() == pytest.approx(0.5, abs=0.02)


def test_no_gaussians_are_allowed():
    assert dropout(torch.empty(0), seed(0), 0.5).shape == (0,)


@pytest.mark.parametrize("fraction", [-0.1, 1.0])
def test_a_fraction_outside_its_range_is_refused(fraction):
    with pytest.raises(ValueError, match="fraction"):
        dropout(torch.ones(3), seed(0), fraction)
