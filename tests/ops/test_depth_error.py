"""Depth against aligned monocular depth."""

import pytest
import torch

from tests.reference.depth_error import depth_error as reference
from tests.reference.depth_error import random_inputs
from tests.scenes import error, generator, relative_error
from warpgs.ops.depth_error import depth_error

SIZES = [(1, 1), (37, 50)]
MARGINS = [0.0, 0.3]
NONE = torch.tensor(0.0)


def doubles(inputs):
    return [t.double() if t.is_floating_point() else t for t in inputs]


@pytest.mark.parametrize("margin", MARGINS)
@pytest.mark.parametrize("size", SIZES)
def test_error_equals_the_reference(size, margin):
    inputs = random_inputs(*size, generator(), margin)
    expected = reference(*doubles(inputs))
    assert expected > 0
    assert error(depth_error(*inputs), expected) < 1e-6 * expected


@pytest.mark.parametrize("margin", MARGINS)
@pytest.mark.parametrize("size", SIZES)
def test_gradient_equals_the_reference(size, margin):
    inputs = random_inputs(*size, generator(), margin)
    double = doubles(inputs)
    inputs[0].requires_grad_()
    double[0].requires_grad_()
    (3.7 * depth_error(*inputs)).backward()
    (3.7 * reference(*double)).backward()
    assert relative_error(inputs[0].grad, double[0].grad) < 1e-6


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


@pytest.mark.parametrize("name", ["depth", "alpha", "inverse_depth", "alignment", "region", "margin"])
@pytest.mark.parametrize(
    "spoil", [lambda t: t[:1] if t.ndim else t[None], lambda t: t.double(), lambda t: t[..., None]]
)
@pytest.mark.usefixtures("contracts_off")
def test_inputs_that_do_not_fit_are_refused(name, spoil):
    names = ["depth", "alpha", "inverse_depth", "alignment", "region", "margin"]
    inputs = dict(zip(names, random_inputs(5, 6, generator()), strict=True))
    with pytest.raises(ValueError, match=" must "):
        depth_error(**{**inputs, name: spoil(inputs[name])})


def test_an_image_without_pixels_is_refused():
    empty = torch.zeros(0, 5)
    with pytest.raises(ValueError, match="depth must have pixels"):
        depth_error(empty, empty, empty, torch.ones(2), empty.bool(), NONE)
