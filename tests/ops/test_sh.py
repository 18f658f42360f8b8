"""Spherical harmonics as colour."""

import pytest
import torch

from tests.ops.alone import spherical_harmonics
from tests.reference.sh import spherical_harmonics as reference
from tests.scenes import assert_same_gradients, error, make_camera, make_splats, random_like, relative_error
from warpgs.ops import sh as sh_op
from warpgs.ops.sh import sh_bwd, sh_fwd

VIEW = make_camera().viewmat


@pytest.fixture(autouse=True, params=["one by one", "in fours"])
def access(request, monkeypatch):
    """Each test accesses bases one by one, as on CPU, and, where possible, in fours, as on CUDA."""
    if request.param == "in fours":
        monkeypatch.setattr(sh_op, "_in_fours", lambda sh: int(sh.shape[1] % 4 == 0))


def inputs(held=3, num=60):
    splats = make_splats(num, degree=held)
    return splats.means, 4 * splats.sh  # wide enough that some colours are cut at zero


@pytest.mark.parametrize("held", range(4))
def test_colours_and_gradients_equal_the_reference(held):
    ours = [t.clone().requires_grad_() for t in inputs(held)]
    theirs = [t.double().requires_grad_() for t in inputs(held)]
    colors = spherical_harmonics(*ours, VIEW)
    expected = reference(*theirs, VIEW.double(), held)
    assert (expected == 0).any()
    assert error(colors, expected) < 2e-6
    (v_output,) = random_like([colors])
    colors.backward(v_output)
    expected.backward(v_output.double())
    if held == 0:
        assert not ours[0].grad.any()
    else:
        assert relative_error(ours[0].grad, theirs[0].grad) < 1e-5
    assert relative_error(ours[1].grad, theirs[1].grad) < 1e-6


def test_the_gradient_of_the_camera_equals_the_reference():
    ours, theirs = VIEW.clone().requires_grad_(), VIEW.double().requires_grad_()
    means, sh = inputs()
    expected = reference(means.double(), sh.double(), theirs, 3)
    assert_same_gradients([spherical_harmonics(means, sh, ours)], [expected], [ours], [theirs])


@pytest.mark.parametrize("degree", range(3))
def test_a_lower_degree_ignores_the_higher_bases(degree):
    means, sh = inputs(3)
    sh.requires_grad_()
    bases = (degree + 1) ** 2
    colors = spherical_harmonics(means, sh, VIEW, degree=degree)
    colors.sum().backward()
    assert torch.equal(colors, spherical_harmonics(means, sh[:, :bases].contiguous(), VIEW))
    assert sh.grad[:, :bases].any()
    assert not sh.grad[:, bases:].any()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_gaussians_without_a_gradient_may_have_values_that_are_not_finite(value):
    means, sh = (t.clone() for t in inputs())
    means[::4, 1], sh[2::4, 0, 2] = value, value
    means.requires_grad_(), sh.requires_grad_()
    view = VIEW.clone().requires_grad_()
    colors = spherical_harmonics(means, sh, view)
    assert colors[2::4].isnan().all()
    (colors[1::2] @ torch.ones(3)).sum().backward()
    for gradient in (means.grad, sh.grad):
        assert not gradient[::2].any()
        assert gradient[1::2].any()
    assert view.grad.isfinite().all()


def test_the_gradient_of_the_means_is_added_to_that_of_the_rest():
    means, sh = inputs()
    colors, v_means, rest = sh_fwd(means, sh, VIEW, 3), torch.zeros_like(means), torch.rand_like(means)
    sh_bwd((means, sh, VIEW), 3, colors, torch.ones_like(colors), v_means)
    both = rest.clone()
    sh_bwd((means, sh, VIEW), 3, colors, torch.ones_like(colors), both)
    assert v_means.any()
    assert torch.equal(both, rest + v_means)


def test_a_gaussian_at_the_viewpoint_has_finite_colour_and_gradients():
    means = torch.zeros(1, 3, requires_grad=True)
    sh = torch.rand(1, 16, 3, requires_grad=True)
    colors = spherical_harmonics(means, sh, torch.eye(4))
    colors.sum().backward()
    assert colors.isfinite().all()
    assert means.grad.isfinite().all()
    assert sh.grad.isfinite().all()


def test_a_camera_that_is_not_finite_has_a_finite_gradient():
    view = torch.full((4, 4), torch.nan, requires_grad=True)
    (0.0 * spherical_harmonics(*inputs(), view)).nan_to_num().sum().backward()
    assert view.grad.isfinite().all()


@pytest.mark.parametrize("num", [0, 1])
def test_few_gaussians_are_enough(num):
    means, sh = (t.clone().requires_grad_() for t in inputs(num=num))
    spherical_harmonics(means, sh, VIEW).sum().backward()
    assert sh.grad.shape == (num, 16, 3)
