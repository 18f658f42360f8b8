"""Deformation along splines."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from tests import plain
from tests.scenes import error, generator
from warpgs.model.spline_deformation import SplineDeformation

NUM_PATHS, NUM_POINTS = 3, 9
NETWORK = plain.model(position_bands=2, time_bands=2, depth=2, width=8)


@pytest.fixture
def model():
    found = SplineDeformation(NETWORK, torch.zeros(3), torch.ones(3))
    found.resize(NUM_PATHS, NUM_POINTS)
    found.paths.data.copy_(torch.randn(found.paths.shape, generator=generator()))
    found.homes.copy_(torch.eye(3))
    return found


@pytest.mark.parametrize("time", [0.0, 0.1, 0.5, 0.83, 1.0])
def test_paths_are_uniform_cubic_splines(model, time):
    pieces = NUM_POINTS - 3
    knots = np.arange(-3, pieces + 4) / pieces
    expected = BSpline(knots, model.paths.detach().double().numpy().swapaxes(0, 1), 3)(time)
    assert error(model.positions(torch.tensor([time])), torch.from_numpy(expected).float()) < 1e-5


def test_a_path_goes_on_beyond_the_first_and_the_last_time(model):
    """Time has noise in training."""
    inside, outside = (model.positions(torch.tensor([t])) for t in (1.0, 1.001))
    assert 0 < error(outside, inside) < 0.1


def test_each_gaussian_moves_with_the_nearest_home(model):
    means = torch.eye(3)[[2, 0, 1, 0]] + 0.1 * torch.randn(4, 3, generator=generator())
    time = torch.tensor([0.4])
    moved = (model.positions(time) - model.homes)[[2, 0, 1, 0]]
    offsets = model(means, time)
    assert error(offsets[:, :3], moved) < 1e-6  # a network adds nothing before training
    assert not offsets[:, 3:].any()
    assert model(means[:0], time).shape == (0, 10)


def test_only_control_points_around_a_time_have_gradients(model):
    model(torch.eye(3), torch.tensor([0.0])).square().sum().backward()
    gradients = model.paths.grad.abs().sum((0, 2))
    assert (gradients[:3] > 0).all()
    assert not gradients[4:].any()


def test_a_state_brings_the_numbers_of_its_paths_and_points(model):
    loaded = SplineDeformation(NETWORK, torch.zeros(3), torch.ones(3))
    loaded.load_state_dict(model.state_dict())
    means, time = torch.randn(4, 3, generator=generator()), torch.tensor([0.3])
    assert torch.equal(loaded(means, time), model(means, time))


@pytest.mark.parametrize("shape", [(3, 9), (3, 3, 3), (3, 9, 4)])
def test_a_state_whose_paths_are_no_splines_is_refused(model, shape):
    with pytest.raises(RuntimeError, match="paths"):
        model.load_state_dict({**model.state_dict(), "paths": torch.zeros(shape)})


def test_gaussians_may_have_their_own_times(model):
    means, times = torch.randn(6, 3, generator=generator()), torch.linspace(-0.1, 1.1, 6)
    offsets = model(means, times)
    for k in range(6):
        assert error(offsets[k], model(means, times[k : k + 1])[k]) < 1e-6
