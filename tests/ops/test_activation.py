"""From raw Gaussians and what the networks say to splats (paper Eq. 5, 8 and 11)."""

import pytest
import torch

from tests.reference.activation import activate as reference
from tests.reference.activation import multiply
from tests.reference.covariance import rotation
from tests.scenes import error, generator, random_like
from warpgs.ops.activation import NO_CHANGES, Changes, Raw, activate

SIZES = [(5, 3), (0, 3), (5, 0), (0, 0), (1, 1)]


def random_raw(num, rest=3, seed=0):
    shapes = [(num, 3), (num, 4), (num, 3), (num,), (num, 1, 3), (num, rest, 3)]
    return Raw(*(torch.randn(shape, generator=generator(seed)) for shape in shapes))


def random_changes(num, bases=2, seed=5):
    shapes = [(num, 10), (num, bases, 3), (num,)]
    return Changes(*(0.3 * torch.randn(shape, generator=generator(seed)) for shape in shapes))


def doubles(tensors):
    return [None if t is None else t.detach().double().requires_grad_() for t in tensors]


@pytest.mark.parametrize(("num_static", "num_dynamic"), SIZES)
@pytest.mark.parametrize("changed", [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize("rest", [0, 3])
def test_values_and_gradients_are_those_of_the_reference(num_static, num_dynamic, changed, rest):
    static, dynamic = random_raw(num_static, rest), random_raw(num_dynamic, rest, seed=1)
    relit = random_changes(num_static, bases=1 + rest // 3) if changed[0] else NO_CHANGES
    moved = random_changes(num_dynamic, bases=1, seed=7) if changed[1] else NO_CHANGES
    inputs = [static, dynamic, relit, moved]
    for tensor in (t for part in inputs for t in part if t is not None):
        tensor.requires_grad_()
    twins = [doubles(part) for part in inputs]
    outputs, expected = activate(*inputs), reference(*twins)
    for value, wanted in zip(outputs, expected, strict=True):
        assert torch.allclose(value.double(), wanted, rtol=2e-6, atol=2e-6)
    cotangents = random_like(outputs)
    torch.autograd.backward(outputs, cotangents)
    torch.autograd.backward(expected, [c.double() for c in cotangents])
    for part, twin in zip(inputs, twins, strict=True):
        for tensor, wanted in zip(part, twin, strict=True):
            if tensor is not None:
                assert torch.allclose(tensor.grad.double(), wanted.grad, rtol=2e-6, atol=5e-6)


def test_what_gets_no_gradient_hands_none_back():
    static = random_raw(4)
    static.means.requires_grad_()
    static.log_scales.requires_grad_()
    activate(static, random_raw(2)).means.sum().backward()
    assert torch.equal(static.means.grad, torch.ones(4, 3))
    assert not static.log_scales.grad.any()


def test_products_of_quaternions_turn_first_by_the_right_one():
    a, b = (torch.randn(6, 4, generator=generator(seed)).double() for seed in (0, 1))
    assert error(rotation(multiply(a, b)), rotation(a) @ rotation(b)) < 1e-12


def test_opacities_stay_within_zero_and_one():
    static = random_raw(2)._replace(logit_opacities=torch.tensor([-1000.0, 1000.0]).requires_grad_())
    opacities = activate(static, random_raw(0)).opacities
    opacities.sum().backward()
    assert opacities.tolist() == [0.0, 1.0]
    assert static.logit_opacities.grad.tolist() == [0.0, 0.0]


def test_more_residuals_than_bases_are_refused():
    with pytest.raises(ValueError, match="static: sh_residuals has 5 bases, but there are only 4"):
        activate(random_raw(2), random_raw(2), relit=random_changes(2, bases=5))


def test_branches_of_different_degrees_are_refused():
    with pytest.raises(ValueError, match=r"dynamic.sh_rest must have shape \[N, rest, 3\] with rest = 3"):
        activate(random_raw(2), random_raw(2, rest=8))
