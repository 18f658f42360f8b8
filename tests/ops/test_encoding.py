"""Sinusoidal encoding (paper Eq. 6)."""

import math

import pytest
import torch

from tests.reference.encoding import encode as reference
from tests.scenes import error, generator
from warpgs.ops.encoding import encode, encoded_size


def random_values(num, dims):
    return 2.0 * torch.rand(num, dims, generator=generator()) - 1.0


def encode_plainly(values, bands):
    dims = values.shape[1]
    return encode(values, bands, torch.zeros(dims), torch.ones(dims))


def test_the_encoding_is_that_of_the_reference():
    values, center, half_size = random_values(50, 3), torch.tensor([0.1, 2.0, -1.0]), torch.tensor([1.0, 3.0, 0.5])
    expected = reference((values.double() - center) / half_size, 6)
    assert error(encode(values, 6, center, half_size), expected) < 3e-5


@pytest.mark.parametrize("bands", [1, 4, 10])
def test_the_encoding_holds_the_values_and_equation_6(bands):
    values = random_values(6, 3)
    encoded = encode_plainly(values, bands)
    for row in range(6):
        p = values[row].tolist()
        sines = [math.sin(2**k * math.pi * x) for x in p for k in range(bands)]
        cosines = [math.cos(2**k * math.pi * x) for x in p for k in range(bands)]
        assert error(encoded[row], torch.tensor([*p, *sines, *cosines], dtype=torch.float64)) < 2e-4


def test_half_precision_is_single_precision_rounded():
    values = random_values(20, 3)
    box = (torch.zeros(3), torch.ones(3))
    assert torch.equal(encode(values, 4, *box, half=True), encode(values, 4, *box).half())


@pytest.mark.parametrize(("dims", "bands"), [(3, 10), (1, 6), (3, 0)])
def test_the_size_of_an_encoding_is_known_beforehand(dims, bands):
    assert encode_plainly(random_values(2, dims), bands).shape == (2, encoded_size(dims, bands))


def test_without_bands_the_values_are_the_encoding():
    values = random_values(5, 3)
    assert torch.equal(encode_plainly(values, 0), values)


def test_no_values_have_an_empty_encoding():
    assert encode_plainly(torch.zeros(0, 3), 4).shape == (0, 27)


def test_each_value_is_encoded_apart_from_the_others():
    values = random_values(1, 3)
    moved = values.clone()
    moved[0, 1] += 0.1
    changed = (encode_plainly(values, 4) != encode_plainly(moved, 4))[0]
    assert changed.nonzero()[:, 0].tolist() == [1, *range(7, 11), *range(19, 23)]


def test_no_gradient_flows_back():
    assert not encode_plainly(random_values(3, 3).requires_grad_(), 2).requires_grad


@pytest.mark.parametrize("values", [torch.zeros(4, 3, dtype=torch.float64), torch.zeros(3, 4).T])
def test_values_that_the_kernel_cannot_read_are_refused(values):
    with pytest.raises(ValueError, match="values must be"):
        encode(values, 2, torch.zeros(3), torch.ones(3))
