"""Depth against aligned monocular depth."""

import pytest
import torch

from tests.reference.depth_error import depth_error as reference
from tests.reference.depth_error import random_inputs
from tests.scenes import assert_same_gradients, error, generator
from warpgs.ops.depth_error import depth_error

NONE = torch.tensor(0.0)
NAMES = ["depth", "alpha", "inverse_depth", "alignment", "region", "margin"]


@pytest.mark.parametrize("margin", [0.0, 0.3])
@pytest.mark.parametrize("size", [(1, 1), (37, 50)])
def test_error_and_gradient_equal_the_reference(size, margin):
    inputs = random_inputs(*size, generator(), margin)
    double = [t.double() if t.is_floating_point() else t for t in inputs]
    ours = depth_error(inputs[0].requires_grad_(), *inputs[1:])
    expected = reference(double[0].requires_grad_(), *double[1:])
    assert expected > 0
    assert error(ours, expected) < 1e-6 * expected
    assert_same_gradients([ours], [expected], inputs[:1], double[:1], tolerance=1e-6)


def test_exact_depth_has_no_error_and_no_gradient():
    depth, opaque, everywhere = torch.full((3, 4), 4.0), torch.ones(3, 4), torch.ones(3, 4, dtype=torch.bool)
    depth.requires_grad_()
    value = depth_error(depth, opaque, torch.full((3, 4), 0.25), torch.tensor([1.0, 0.0]), everywhere, NONE)
    value.backward()
    assert value == 0
    assert not depth.grad.any()


@pytest.mark.parametrize(("depth", "expected"), [(3.7, 0.0), (4.3, 0.0), (3.2, 0.4), (5.0, 0.6)])
def test_errors_within_the_margin_are_free_and_larger_ones_count_from_its_end(depth, expected):
    rendered, one, everywhere = torch.full((1, 1), depth, requires_grad=True), torch.ones(1, 1), torch.ones(1, 1).bool()
    value = depth_error(rendered, one, one / 4.0, torch.tensor([1.0, 0.0]), everywhere, torch.tensor(0.1))
    value.backward()
    assert value.item() == pytest.approx(expected, abs=1e-6)
    assert rendered.grad.item() == (0.0 if expected == 0.0 else 1.0 if depth > 4.0 else -1.0)


@pytest.mark.parametrize("alignment", [[torch.nan, torch.nan], [-1.0, 0.0], [0.0, 1e-3]])
def test_an_alignment_without_valid_targets_has_no_error(alignment):
    depth, alpha, inverse_depth, _, region, margin = random_inputs(5, 6, generator())
    depth.requires_grad_()
    value = depth_error(depth, alpha, inverse_depth, torch.tensor(alignment), region, margin)
    value.backward()
    assert value == 0
    assert not depth.grad.any()


def test_only_depth_gets_a_gradient():
    inputs = [t.requires_grad_() if t.is_floating_point() else t for t in random_inputs(5, 6, generator())]
    depth_error(*inputs).backward()
    assert [t.grad is None for t in inputs] == [False, True, True, True, True, True]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "spoil", [lambda t: t[:1] if t.ndim else t[None], lambda t: t.double(), lambda t: t[..., None]]
)
@pytest.mark.usefixtures("contracts_off")
def test_inputs_that_do_not_fit_are_refused(name, spoil):
    inputs = dict(zip(NAMES, random_inputs(5, 6, generator()), strict=True))
    with pytest.raises(ValueError, match=" must "):
        depth_error(**{**inputs, name: spoil(inputs[name])})


def test_an_image_without_pixels_is_refused():
    empty = torch.zeros(0, 5)
    with pytest.raises(ValueError, match="depth must have pixels"):
        depth_error(empty, empty, empty, torch.ones(2), empty.bool(), NONE)
