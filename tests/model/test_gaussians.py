"""Gaussians as they are optimized."""

import pytest
import torch

from tests.reference.sh import spherical_harmonics
from tests.scenes import error, make_camera, random_gaussians
from warpgs.model.gaussians import PARAMETERS, Gaussians


def copies(gaussians):
    return {name: p.detach().clone() for name, p in gaussians.named_parameters()}


def test_gaussians_have_the_parameters_in_the_list():
    assert [name for name, _ in random_gaussians(2).named_parameters()] == list(PARAMETERS)


def test_opacities_are_the_logistic_function_of_their_logits():
    gaussians = random_gaussians(50)
    expected = 1.0 / (1.0 + torch.exp(-gaussians.logit_opacities.detach().double()))
    assert error(gaussians.opacities, expected) < 1e-6


def test_opacities_stay_within_zero_and_one_whatever_their_logits():
    gaussians = random_gaussians(2)
    gaussians.logit_opacities.data = torch.tensor([-1e30, 1e30])
    assert gaussians.opacities.tolist() == [0.0, 1.0]


def test_scales_are_positive_whatever_their_logarithms():
    gaussians = random_gaussians(50)
    gaussians.log_scales.data *= 10.0
    assert (gaussians.scales > 0).all()
    assert error(gaussians.scales.log(), gaussians.log_scales) < 1e-5


def test_the_constant_coefficient_comes_first():
    gaussians = random_gaussians(7)
    assert torch.equal(gaussians.sh[:, 0], gaussians.sh_dc[:, 0])
    assert torch.equal(gaussians.sh[:, 1:], gaussians.sh_rest)


def test_gradients_reach_every_parameter_through_the_activations():
    gaussians = random_gaussians(5)
    values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    sum(value.sum() for value in values).backward()
    for parameter in gaussians.parameters():
        assert parameter.grad.all()


@pytest.mark.parametrize("parents", [[], [2], [0, 1, 2, 3], [3, 3, 0, 3, 1, 2, 2]])
def test_gathering_copies_the_parents(parents):
    gaussians = random_gaussians(4)
    before = copies(gaussians)
    gaussians.gather(torch.tensor(parents, dtype=torch.int64))
    assert len(gaussians) == len(parents)
    for name, parameter in gaussians.named_parameters():
        assert torch.equal(parameter, before[name][parents])


def test_gathering_keeps_parameter_objects_and_requires_grad():
    gaussians = random_gaussians(4)
    gaussians.sh_rest.requires_grad_(False)
    before = {name: (id(p), p.requires_grad) for name, p in gaussians.named_parameters()}
    gaussians.gather(torch.tensor([1, 1]))
    assert {name: (id(p), p.requires_grad) for name, p in gaussians.named_parameters()} == before


def test_copies_of_one_parent_do_not_share_memory():
    gaussians = random_gaussians(2)
    gaussians.gather(torch.tensor([1, 1]))
    first = gaussians.means[0].detach().clone()
    gaussians.means.data[1] += 1.0
    assert torch.equal(gaussians.means[0], first)


def test_gathering_drops_gradients():
    gaussians = random_gaussians(3)
    for parameter in gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    gaussians.gather(torch.arange(3))
    assert all(parameter.grad is None for parameter in gaussians.parameters())


def test_gaussians_at_points_are_isotropic_with_the_given_scales_and_opacity():
    scales = torch.tensor([0.1, 2.0])
    gaussians = Gaussians.from_points(torch.randn(2, 3), torch.rand(2, 3), scales, 0.3)
    assert error(gaussians.scales, scales[:, None].expand(2, 3)) < 1e-6
    assert torch.equal(gaussians.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2))
    assert error(gaussians.opacities, torch.full((2,), 0.3)) < 1e-6


def test_gaussians_at_points_have_the_given_colours_in_all_directions():
    means, colors = torch.randn(20, 3), torch.rand(20, 3)
    gaussians = Gaussians.from_points(means, colors, torch.ones(20), 0.3)
    actual = spherical_harmonics(means.double(), gaussians.sh.double(), make_camera().viewmat.double(), 3)
    assert error(actual, colors) < 1e-6


def test_gaussians_at_points_copy_the_points():
    points = torch.zeros(2, 3)
    gaussians = Gaussians.from_points(points, torch.rand(2, 3), torch.ones(2), 0.3)
    gaussians.means.data += 1.0
    assert not points.any()


@pytest.mark.parametrize("num", [0, 1, 5])
def test_empty_gaussians_load_the_state_of_others(num):
    gaussians, other = Gaussians.empty(num), random_gaussians(num)
    gaussians.load_state_dict(other.state_dict())
    for name, parameter in gaussians.named_parameters():
        assert torch.equal(parameter, getattr(other, name))


@pytest.mark.parametrize("degree", range(4))
def test_gaussians_have_the_coefficients_up_to_their_degree(degree):
    points = Gaussians.from_points(torch.zeros(2, 3), torch.rand(2, 3), torch.ones(2), 0.5, degree)
    for gaussians in (points, Gaussians.empty(2, degree)):
        assert gaussians.sh.shape == (2, (degree + 1) ** 2, 3)
