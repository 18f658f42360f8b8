"""Activation of raw Gaussians with the outputs of the networks (paper Eq. 5, 8 and 11)."""

from itertools import chain

import pytest
import torch

from tests.reference import activation as reference
from tests.reference.covariance import rotation
from tests.scenes import error, generator, random_like
from warpgs.kernels import activation as kernels
from warpgs.ops.activation import NO_CHANGES, NUM_GEOMETRY, Changes, Raw, activate, join_sh
from warpgs.runtime.launch import launch

SIZES = [(5, 3), (0, 3), (5, 0), (0, 0), (1, 1)]


def random_raw(num, rest=3, seed=0):
    shapes = [(num, 3), (num, 4), (num, 3), (num,), (num, 1, 3), (num, rest, 3)]
    return Raw(*(torch.randn(shape, generator=generator(seed)) for shape in shapes))


def random_changes(num, seed=5):
    return Changes(*(0.3 * torch.randn(shape, generator=generator(seed)) for shape in [(num, 10), (num,)]))


def random_residuals(num, bases):
    return 0.3 * torch.randn(num, bases, 3, generator=generator(6))


def leaves(tensors):
    return [None if t is None else t.requires_grad_() for t in tensors]


def doubles(tensors):
    return [None if t is None else t.detach().double().requires_grad_() for t in tensors]


def assert_same(ours, expected, inputs, twins):
    """Compares values, and the gradients of all inputs that have any."""
    for value, wanted in zip(ours, expected, strict=True):
        assert torch.allclose(value.double(), wanted, rtol=2e-6, atol=2e-6)
    v_outputs = random_like(ours)
    torch.autograd.backward(ours, v_outputs)
    torch.autograd.backward(expected, [c.double() for c in v_outputs])
    for tensor, wanted in zip(inputs, twins, strict=True):
        if tensor is not None and wanted.grad is not None:
            assert torch.allclose(tensor.grad.double(), wanted.grad, rtol=2e-6, atol=5e-6)


@pytest.mark.parametrize(("num_static", "num_dynamic"), SIZES)
@pytest.mark.parametrize("changed", [(False, False), (True, False), (False, True), (True, True)])
def test_geometry_and_its_gradients_equal_the_reference(num_static, num_dynamic, changed):
    static, dynamic = random_raw(num_static), random_raw(num_dynamic, seed=1)
    static_changes = random_changes(num_static) if changed[0] else NO_CHANGES
    dynamic_changes = random_changes(num_dynamic, seed=7) if changed[1] else NO_CHANGES
    parts = [static, dynamic, static_changes, dynamic_changes]
    twins = [doubles(part) for part in parts]
    inputs = [leaves(part) for part in parts]
    assert_same(activate(*parts), reference.activate(*twins), [*chain(*inputs)], [*chain(*twins)])
    assert all(t.grad is not None for part in inputs for t in part[:NUM_GEOMETRY] if t is not None)


@pytest.mark.parametrize(("num_static", "num_dynamic"), SIZES)
@pytest.mark.parametrize("rest", [0, 3])
@pytest.mark.parametrize("changed", [0, 1])
def test_colours_and_their_gradients_equal_the_reference(num_static, num_dynamic, rest, changed):
    static, dynamic = random_raw(num_static, rest), random_raw(num_dynamic, rest, seed=1)
    residuals = random_residuals(num_static, 1 + rest // 3) if changed else None
    inputs = leaves([*static, *dynamic, residuals])
    twins = doubles(inputs)
    expected = reference.join_sh(Raw(*twins[:6]), Raw(*twins[6:12]), twins[12])
    assert_same([join_sh(static, dynamic, residuals)], [expected], inputs, twins)
    assert static.sh_dc.grad is not None
    assert dynamic.sh_rest.grad is not None


@pytest.mark.parametrize("num_residuals", [None, 1, 2])
def test_the_kernels_of_cuda_copy_coefficients_as_the_cpu_does(num_residuals):
    raw = random_raw(3)
    residuals = None if num_residuals is None else random_residuals(3, num_residuals)
    given = [t for t in leaves([raw.sh_dc, raw.sh_rest, residuals]) if t is not None]
    expected, v_sh = join_sh(raw, random_raw(0), residuals), torch.randn(3, 4, 3, generator=generator())
    v_expected = torch.autograd.grad(expected, given, v_sh)
    missing, sh, v_given = [None] * (3 - len(given)), torch.zeros(3, 4, 3), [torch.zeros_like(t) for t in given]
    launch(kernels.join_sh_fwd, sh.shape[0] * sh.shape[1], *(t.detach() for t in given), *missing, 0, sh)
    launch(kernels.join_sh_bwd, sh.shape[0] * sh.shape[1], v_sh, 0, *v_given, *missing)
    assert torch.equal(sh, expected)
    assert all(torch.equal(v, wanted) for v, wanted in zip(v_given, v_expected, strict=True))


def test_outputs_without_a_gradient_contribute_zero():
    static = random_raw(4)
    static.means.requires_grad_()
    static.log_scales.requires_grad_()
    activate(static, random_raw(2)).means.sum().backward()
    assert torch.equal(static.means.grad, torch.ones(4, 3))
    assert not static.log_scales.grad.any()


def test_a_product_of_quaternions_rotates_by_the_right_factor_first():
    a, b = (torch.randn(6, 4, generator=generator(seed)).double() for seed in (0, 1))
    assert error(rotation(reference.multiply(a, b)), rotation(a) @ rotation(b)) < 1e-12


def test_opacities_stay_between_zero_and_one():
    static = random_raw(2)._replace(logit_opacities=torch.tensor([-1000.0, 1000.0]).requires_grad_())
    opacities = activate(static, random_raw(0)).opacities
    opacities.sum().backward()
    assert opacities.tolist() == [0.0, 1.0]
    assert static.logit_opacities.grad.tolist() == [0.0, 0.0]


def test_more_residuals_than_bases_are_refused():
    with pytest.raises(ValueError, match="sh_residuals has 5 bases, but there are only 4"):
        join_sh(random_raw(2), random_raw(2), random_residuals(2, 5))


def test_branches_of_different_degrees_are_refused():
    with pytest.raises(ValueError, match=r"dynamic.sh_rest must have shape \[N, rest, 3\] with rest = 3"):
        join_sh(random_raw(2), random_raw(2, rest=8))


def test_offsets_of_another_number_of_gaussians_are_refused():
    with pytest.raises(ValueError, match=r"dynamic\.offsets must have shape \[N, 10\] with N = 2"):
        activate(random_raw(2), random_raw(2), dynamic_changes=random_changes(3))
