"""Covariances from quaternions and scales, and Warp's generated adjoint."""

import pytest
import torch

from tests.reference.covariance import covariance as reference
from tests.scenes import error, make_splats, random_like, relative_error
from warpgs.ops.covariance import covariance


def test_covariance_equals_the_reference():
    splats = make_splats()
    expected = reference(splats.quats.double(), splats.scales.double())
    assert error(covariance(splats.quats, splats.scales), expected) < 2e-6


def test_gradients_equal_the_reference():
    splats = make_splats()
    inputs = [t.clone().requires_grad_() for t in (splats.quats, splats.scales)]
    doubles = [t.double().requires_grad_() for t in (splats.quats, splats.scales)]
    value = covariance(*inputs)
    (v_output,) = random_like([value])
    value.backward(v_output)
    reference(*doubles).backward(v_output.double())
    for actual, expected in zip(inputs, doubles, strict=True):
        assert relative_error(actual.grad, expected.grad) < 2e-6


def test_the_length_of_a_quaternion_does_not_matter():
    splats = make_splats()
    plain = covariance(splats.quats, splats.scales)
    assert error(covariance(splats.quats * 7.0, splats.scales), plain) < 2e-6


def test_a_zero_quaternion_has_zero_covariance_and_zero_gradients():
    quats = torch.zeros(1, 4, requires_grad=True)
    scales = torch.ones(1, 3, requires_grad=True)
    value = covariance(quats, scales)
    value.sum().backward()
    assert not value.any()
    assert not quats.grad.any()
    assert not scales.grad.any()


@pytest.mark.parametrize("num", [0, 1])
def test_few_gaussians_are_enough(num):
    splats = make_splats(num)
    value = covariance(splats.quats.requires_grad_(), splats.scales)
    value.sum().backward()
    assert value.shape == (num, 3, 3)
    assert splats.quats.grad.shape == (num, 4)
